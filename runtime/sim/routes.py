"""How an arm picks a block up and puts it down: legs of joint targets, timed, with gates for the jaws between.

Four points of every vertical way are solved by inverse kinematics; the rows between them are interpolated in
joint space with minimum-jerk timing (Flash and Hogan 1985), so that an attempt is planned once and cheaply.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from robots.rotations import quaternion_of_matrix
from runtime.errors import SetupError
from runtime.kinematics.numeric import NumericKinematics
from runtime.sim import bench
from runtime.sim.bench import Bench
from runtime.types import Float64

if TYPE_CHECKING:
    from robots import Gripper, Group, Robot

CLEAR = 0.12  # m: fingertips so high pass over everything, also with a block between them
_GRASP = 0.45  # of the block's edge: the height of the fingertips that grasp it
_DROP = 0.003  # m between block and plate when the jaws open
_TILTS = ((0.0, 0.26), (0.26, 0.26), (0.4, 0.4))  # rad outwards from straight down: below, above
_SPEED = 0.75  # rad/s of the fastest joint, at its fastest
_TIP_SPEED = 0.11  # m/s on vertical ways, at its fastest
_SHORTEST = 0.5  # s
_JAW_SPEED = 0.16  # m/s
_PAUSE = 0.3  # s that a route stands still at first: its rows arrive late
_MARGIN = 0.05  # of the jaws' whole way, at both ends
_DWELL = 0.2  # s by which a gate outlasts the way of its jaws
_PEAK = 1.875  # highest over mean speed of a minimum-jerk motion
_AHEAD = 0.3  # m from an arm's base to the place over which searches begin
_TRIES = 200
_STATIONS = 4
_ACROSS = math.pi / 2

Gate = Literal["", "close", "open"]
Place = tuple[float, float]
Tilts = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """Rows float64 [n, D], one per control period; a gate's leg ends when the jaws are seen to have obeyed."""

    name: str
    rows: Float64
    gate: Gate = ""

    @property
    def end(self) -> Float64:
        """Its last row [D]."""
        return np.asarray(self.rows[-1])


@dataclass(frozen=True, slots=True)
class Slip:
    """What goes wrong on purpose: the jaws close `short` of the block [m], or let it go on the way."""

    short: float = 0.0
    lets_go: bool = False


@dataclass(frozen=True, eq=False)
class Route:
    """What one arm does, leg after leg; the rest of the robot stays.

    `rows` [N, D] are those of all legs, `starts` the places of each leg's first one among them.
    """

    arm: Group
    legs: tuple[Leg, ...]

    @cached_property
    def rows(self) -> Float64:
        return np.concatenate([leg.rows for leg in self.legs])

    @cached_property
    def starts(self) -> tuple[int, ...]:
        return tuple(itertools.accumulate((len(leg.rows) for leg in self.legs[:-1]), initial=0))


class Planner:
    """Plans for one robot at one bench, `rate` rows per second."""

    def __init__(self, robot: Robot, rate: float, table: Bench) -> None:
        self._robot = robot
        self._rate = rate
        self._bench = table
        self._kinematics = NumericKinematics(robot)
        self._rest = robot.poses.get("ready", robot.poses["home"])
        self._speed = np.minimum(0.5 * robot.velocity, _SPEED)
        for arm in robot.arms:
            self._speed[gripper_dim(arm)] = _JAW_SPEED
        self._nominal = {arm.name: self._search(arm) for arm in robot.arms}

    def pick_and_place(
        self, q: Float64, block: tuple[float, float, float], plate: Place, slip: Slip
    ) -> Route | None:
        """The route from joints q [D], by the arm nearest the block that reaches all of it; None if none does."""
        for arm in sorted(self._robot.arms, key=lambda arm: math.dist(arm.mount[:2], block[:2])):
            for tilts in _TILTS:
                down, over = self._stations(arm, q, block, plate, slip.short, tilts)
                if down is not None and over is not None:
                    return self._route(arm, q, down, over, slip)
        return None

    def retreat(self, q: Float64, arm: Group) -> Route:
        """Open the jaws, rise, and go where the arm is out of the camera's way."""
        high = self._with_jaws(arm, self._risen(arm, q), _opened(arm))
        return self._begun(
            arm, [self._leg("back off", q, high), self._leg("retreat", high, self._rested(arm, q))]
        )

    def hover(self, arm: Group, q: Float64, place: Place, height: float) -> Float64 | None:
        """Joints [D] with an arm's fingertips over a place at a height, its jaws open; None where it cannot reach."""
        tilt = _TILTS[0][1]
        way = self._down(arm, q, place, 0.0, (height, CLEAR), (tilt, tilt))
        return None if way is None else np.asarray(way[-1])

    # --- legs ----------------------------------------------------------------------------------------------

    def _route(self, arm: Group, q: Float64, down: Float64, over: Float64, slip: Slip) -> Route:
        """From the stations above to below the block, `down`, and the plate, `over`, [stations, D], jaws open."""
        held, lowered = (self._with_jaws(arm, way, _closed(arm)) for way in (down, over))
        legs = []
        if bench.tip_in_world(arm, q)[2, 3] < 0.75 * CLEAR:
            legs.append(self._leg("rise", q, self._risen(arm, q)))
            q = legs[-1].end
        legs += [self._leg("reach", q, down[0]), self._vertical_leg("descend", down)]
        legs += [self._jaw_leg("close", down[-1], held[-1]), self._vertical_leg("lift", held[::-1])]
        carry = self._leg("carry", held[0], lowered[0])
        if slip.lets_go:
            half = carry.rows[: len(carry.rows) // 2]
            last = self._with_jaws(arm, half[-1], _opened(arm))
            legs += [Leg("carry", half), self._jaw_leg("open", half[-1], last)]
        else:
            last = over[0]
            legs += [carry, self._vertical_leg("lower", lowered)]
            legs += [self._jaw_leg("open", lowered[-1], over[-1]), self._vertical_leg("leave", over[::-1])]
        legs.append(self._leg("retreat", last, self._rested(arm, q)))
        return self._begun(arm, legs)

    def _begun(self, arm: Group, legs: Sequence[Leg]) -> Route:
        first = legs[0]
        still = np.repeat(first.rows[:1], round(_PAUSE * self._rate), axis=0)
        return Route(arm, (replace(first, rows=np.concatenate([still, first.rows])), *legs[1:]))

    def _leg(self, name: str, start: Float64, end: Float64) -> Leg:
        return Leg(name, self._timed(np.stack([start, end]), 0.0))

    def _vertical_leg(self, name: str, stations: Float64) -> Leg:
        return Leg(name, self._timed(stations, _PEAK * CLEAR / _TIP_SPEED))

    def _jaw_leg(self, gate: Literal["close", "open"], start: Float64, end: Float64) -> Leg:
        rows = self._timed(np.stack([start, end]), 0.0)
        return Leg(
            gate, np.concatenate([rows, np.repeat(rows[-1:], round(_DWELL * self._rate), axis=0)]), gate
        )

    def _timed(self, stations: Float64, shortest: float) -> Float64:
        """Rows [n, D] through stations [k, D], at rest at both ends: a polynomial, run with minimum jerk."""
        marks = np.linspace(0.0, 1.0, len(stations))
        powers = np.linalg.solve(np.vander(marks, increasing=True), stations)
        way = np.abs(np.diff(stations, axis=0)).sum(axis=0)
        seconds = max(_SHORTEST, shortest, _PEAK * float((way / self._speed).max()))
        u = np.linspace(0.0, 1.0, 1 + math.ceil(seconds * self._rate))
        s = u**3 * (10 - 15 * u + 6 * u * u)
        rows = np.vander(s, len(stations), increasing=True) @ powers
        return np.asarray(np.clip(rows, self._robot.lower, self._robot.upper))

    # --- points --------------------------------------------------------------------------------------------

    def _stations(
        self,
        arm: Group,
        q: Float64,
        block: tuple[float, float, float],
        plate: Place,
        short: float,
        tilts: Tilts,
    ) -> tuple[Float64 | None, Float64 | None]:
        """Joints [stations, D] from above to below the block, and the same over the plate."""
        base = arm.mount[:2]
        reach = math.dist(base, block[:2])
        x, y = base + (np.array(block[:2]) - base) * (1 - short / reach)
        bearing = self._bearing(arm, (x, y))
        twist = math.remainder(block[2] - bearing, math.pi / 2)  # of the jaws, from across the arm
        low = _GRASP * self._bench.block_edge
        put = self._bench.plate_height + low + _DROP
        down = self._down(arm, q, (x, y), twist, (low, CLEAR), tilts)
        return down, down if down is None else self._down(arm, q, plate, twist, (put, CLEAR), tilts)

    def _down(
        self, arm: Group, q: Float64, place: Place, twist: float, heights: tuple[float, float], tilts: Tilts
    ) -> Float64 | None:
        """Joints [stations, D] of an arm with open jaws, the others as in q [D]; None where it cannot reach."""
        bearing = self._bearing(arm, place)
        seed, across = self._nominal[arm.name]
        start = self._with_jaws(arm, q, _opened(arm))
        start[arm.joint_dims] = seed
        start[arm.joint_dims[0]] += bearing - self._bearing(arm, self._ahead(arm))
        start = np.clip(start, self._robot.lower, self._robot.upper)
        yaw = bearing + across + twist
        way = np.linspace((heights[1], tilts[1]), (heights[0], tilts[0]), _STATIONS)
        tips = [_tip(place, height, yaw, bearing, tilt) for height, tilt in way]
        return self._solved(arm, tips, start)

    def _solved(self, arm: Group, tips: Sequence[Float64], seed: Float64) -> Float64 | None:
        """Joints [T, D] for the fingertips' transforms in the world; None where one of them is not reached."""
        index = self._robot.arms.index(arm)
        assert arm.tip is not None
        eef = np.linalg.inv(bench.mount_of(arm)) @ np.stack(tips) @ np.linalg.inv(arm.tip)
        targets = np.repeat(self._kinematics.forward(seed)[None], len(eef), axis=0)
        targets[:, index, :3] = eef[:, :3, 3]
        targets[:, index, 3:] = quaternion_of_matrix(eef[:, :3, :3])
        result = self._kinematics.solve(targets, seed)
        return result.q if result.reached[:, index].all() else None

    def _search(self, arm: Group) -> tuple[Float64, float]:
        """The arm's joints with its fingertips down ahead of it, and the jaws' turn from its bearing there.

        From the rest posture, then from random ones; SetupError where the arm cannot do it or has no jaws.
        """
        if arm.tip is None or jaws(arm).unit != "m":
            raise SetupError(f"{arm.name} cannot pick things up: it needs fingertips and a gripper in m")
        chance = np.random.default_rng(0)
        place, seed = self._ahead(arm), self._rest
        bearing = self._bearing(arm, place)
        for _ in range(_TRIES):
            for across in (_ACROSS, -_ACROSS):
                tip = _tip(place, CLEAR, bearing + across, bearing, _TILTS[0][1])
                found = self._solved(arm, [tip], seed)
                if found is not None:
                    return found[0, arm.joint_dims], across
            seed = chance.uniform(self._robot.lower, self._robot.upper)
        raise SetupError(f"{arm.name} cannot hold its fingertips down {_AHEAD} m ahead of it")

    def _ahead(self, arm: Group) -> Place:
        x, y = (bench.mount_of(arm) @ [_AHEAD, 0.0, 0.0, 1.0])[:2]
        return float(x), float(y)

    def _bearing(self, arm: Group, place: Place) -> float:
        return math.atan2(place[1] - arm.mount[1], place[0] - arm.mount[0])

    def _risen(self, arm: Group, q: Float64) -> Float64:
        """Joints [D] with the fingertips straight up from where they are; q where they are high or cannot."""
        tip = bench.tip_in_world(arm, q)
        if tip[2, 3] >= CLEAR:
            return q
        place = float(tip[0, 3]), float(tip[1, 3])
        yaw, bearing = math.atan2(tip[1, 1], tip[0, 1]), self._bearing(arm, place)
        for _, tilt in _TILTS:
            found = self._solved(arm, [_tip(place, CLEAR, yaw, bearing, tilt)], q)
            if found is not None:
                return np.asarray(found[0])
        return q

    def _rested(self, arm: Group, q: Float64) -> Float64:
        rest = q.copy()
        rest[arm.slice] = self._rest[arm.slice]
        return self._with_jaws(arm, rest, _opened(arm))

    def _with_jaws(self, arm: Group, q: Float64, opening: float) -> Float64:
        changed = q.copy()
        changed[..., gripper_dim(arm)] = opening
        return changed


def jaws(arm: Group) -> Gripper:
    """The gripper of an arm."""
    assert arm.gripper is not None  # an arm is a group with a gripper
    return arm.gripper


def gripper_dim(arm: Group) -> int:
    """The place of an arm's gripper in the robot's vector."""
    assert arm.gripper_dim is not None
    return arm.gripper_dim


def _opened(arm: Group) -> float:
    """Nearly as far as the jaws go: safety slows them close to their limits."""
    return jaws(arm).open + _MARGIN * (jaws(arm).close - jaws(arm).open)


def _closed(arm: Group) -> float:
    return jaws(arm).close + _MARGIN * (jaws(arm).open - jaws(arm).close)


def _tip(place: Place, height: float, yaw: float, bearing: float, tilt: float) -> Float64:
    """Fingertips [4, 4] over a place: pointing down, `tilt` outwards, the jaws opening along `yaw`."""
    sine, cosine = math.sin(tilt), math.cos(tilt)
    ahead = np.array([sine * math.cos(bearing), sine * math.sin(bearing), -cosine])
    across = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    across -= ahead * (across @ ahead)
    across /= np.linalg.norm(across)
    tip = np.eye(4)
    tip[:3, :3] = np.column_stack([np.cross(across, ahead), across, ahead])
    tip[:3, 3] = *place, height
    return tip
