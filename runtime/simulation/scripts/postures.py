"""Joints of an arm for fingertips that point down above a block or a plate.

Four points of every vertical path are solved by inverse kinematics. The solver starts from a nominal posture of the arm
with its fingers down, which is searched once. If the first joint turns the arm about the vertical, the nominal posture
is rotated about it towards the path. Otherwise, or if that fails, the solver follows a path from the nominal posture to
the first point.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from robots.rotations import quaternion_of_matrix
from runtime.core.errors import SetupError
from runtime.core.types import Float64
from runtime.kinematics.compiled import CompiledKinematics
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.bench import Bench
from runtime.simulation.scripts.downward_tip import DownwardTip, Place

if TYPE_CHECKING:
    from robots import Gripper, Group, Robot

CLEAR = 0.12  # [m] height at which fingertips pass over everything, even with a block
TILTS = ((0.0, 0.26), (0.26, 0.26), (0.4, 0.4))  # [rad] outwards from straight down: below, above
_GRASP = 0.45  # of the block's edge: height of the fingertips in a grasp
_DROP = 0.003  # [m] between block and plate when the jaws open
_MARGIN = 0.05  # share of the jaws' range that is not used, at both ends
_AHEAD = 0.3  # [m] from an arm's shoulder to the first place of searches, away from the table's near side
_ASIDE = 0.05  # [m] beyond the area in which searches may begin
_TRIES = 60  # seed postures of a search
_ENOUGH = 0.8  # share of an arm's places that is sufficient
_STATIONS = 4
_ACROSS = math.pi / 2

Tilts = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Nominal:
    """Joints `joints` [n] of an arm whose fingertips point down at the pose `down`.

    `across` is the angle between the bearing of this pose and the direction in which the jaws open [rad].
    """

    joints: Float64
    down: DownwardTip
    across: float


class Postures:
    """Postures of one robot at one bench; `arms` are those that can pick objects up.

    Raises:
        SetupError: If no arm can pick objects up; the message states the reason for each.
    """

    def __init__(self, robot: Robot, table: Bench) -> None:
        self._robot = robot
        self._table = table
        self._kinematics = CompiledKinematics(robot)
        self._rest = robot.poses.get("ready", robot.poses["home"])
        self._limbs = arm_frames(robot)
        self._shoulders = {name: limb.shoulder(self._rest)[:2, 3] for name, limb in self._limbs.items()}
        self._nominal: dict[str, Nominal] = {}
        faults = [fault for arm in robot.arms if (fault := self._learn(arm))]
        if not self._nominal:
            raise SetupError(f"{robot.name} cannot pick things up: {'; '.join(faults) or 'it has no arm'}")

    @property
    def arms(self) -> tuple[Group, ...]:
        return tuple(arm for arm in self._robot.arms if arm.name in self._nominal)

    def distance(self, arm: Group, place: Sequence[float]) -> float:
        """Return the horizontal distance from an arm's shoulder to a place [m]."""
        return math.dist(self._shoulders[arm.name], place[:2])

    def hover(self, arm: Group, q: Float64, place: Place, height: float) -> Float64 | None:
        """Return joints [D] with an arm's fingertips above `place` at `height`, jaws open; None if it cannot reach."""
        tilt = TILTS[0][1]
        joint_path = self._down(arm, q, place, 0.0, (height, CLEAR), (tilt, tilt))
        return None if joint_path is None else np.asarray(joint_path[-1])

    def stations(
        self,
        arm: Group,
        q: Float64,
        block: tuple[float, float, float],
        plate: Place,
        short: float,
        tilts: Tilts,
    ) -> tuple[Float64 | None, Float64 | None]:
        """Return joints [stations, D] on the vertical path down to the block, and on the path down to the plate.

        Each path is a row of stations, poses of the fingertips from the top to the bottom. A result is None if the arm
        does not reach that path. The jaws grasp the pair of sides that needs the smaller rotation; if that is not
        reached, the other pair. `short` [m] is a deliberate error: the arm reaches for a place that is so much nearer
        to its shoulder than the block. `tilts` are the angles [rad] of the fingers outwards from straight down, at the
        bottom and at the top.
        """
        base = self._shoulders[arm.name]
        reach = math.dist(base, block[:2])
        x, y = base + (np.array(block[:2]) - base) * (1 - short / reach)
        bearing = self._bearing(arm, (x, y))
        twist = math.remainder(block[2] - bearing, math.pi / 2)  # of the jaws, from across the arm
        low = _GRASP * self._table.block_edge
        put = self._table.discs[0].height + low + _DROP
        first: tuple[Float64 | None, Float64 | None] = None, None
        for turned in (twist, twist - math.copysign(math.pi / 2, twist)):
            down = self._down(arm, q, (x, y), turned, (low, CLEAR), tilts)
            over = None if down is None else self._down(arm, q, plate, turned, (put, CLEAR), tilts)
            if over is not None:
                return down, over
            first = first if first[0] is not None else (down, over)
        return first

    def risen(self, arm: Group, q: Float64) -> Float64:
        """Return joints [D] with the fingertips raised straight up; `q` if they are high already or cannot be
        raised.
        """
        tip = self.tip(arm, q)
        if tip[2, 3] >= CLEAR:
            return q
        place = float(tip[0, 3]), float(tip[1, 3])
        yaw, bearing = math.atan2(tip[1, 1], tip[0, 1]), self._bearing(arm, place)
        for _, tilt in TILTS:
            solution = self._solved(arm, [DownwardTip(place, CLEAR, yaw, bearing, tilt)], q)
            if solution is not None:
                return np.asarray(solution[0])
        return q

    def stowed(self, arm: Group, q: Float64) -> Float64:
        """Return joints [D] with an arm in its rest posture and its jaws as in `q`."""
        stowed = q.copy()
        stowed[arm.joint_dims] = self._rest[arm.joint_dims]
        return stowed

    def rested(self, arm: Group, q: Float64) -> Float64:
        """Return joints [D] with an arm in its rest posture and its jaws open."""
        return opened(arm, self.stowed(arm, q))

    def tip(self, arm: Group, q: Float64) -> Float64:
        """Return an arm's fingertips in the world [4, 4] at joints q [D]."""
        return self._limbs[arm.name].tip(q)

    def _down(
        self, arm: Group, q: Float64, place: Place, twist: float, heights: tuple[float, float], tilts: Tilts
    ) -> Float64 | None:
        """Return joints [stations, D] of an arm with open jaws on a vertical path to `place`.

        The result is None if the arm cannot reach a station of the path. All other joints are those of `q` [D]. `twist`
        is the rotation of the jaws from across the arm [rad]. `heights` [m] and `tilts` [rad] are those of the
        fingertips at the bottom and at the top of the path.
        """
        bearing = self._bearing(arm, place)
        yaw = bearing + self._nominal[arm.name].across + twist
        profile = np.linspace((heights[1], tilts[1]), (heights[0], tilts[0]), _STATIONS)
        stations = [DownwardTip(place, height, yaw, bearing, tilt) for height, tilt in profile.tolist()]
        return self._descent(arm, q, self._nominal[arm.name], stations)

    def _descent(
        self, arm: Group, q: Float64, nominal: Nominal, stations: Sequence[DownwardTip]
    ) -> Float64 | None:
        """Return joints [stations, D] for the poses `stations`; None if the arm does not reach one of them.

        If the first joint is upright, the search begins at the nominal posture, rotated about this joint. If this
        fails, or the joint is not upright, the search follows a path from the nominal posture to the first pose.
        """
        start = opened(arm, q)
        start[arm.joint_dims] = nominal.joints
        if upright := self._limbs[arm.name].upright:
            turned = start.copy()
            turned[arm.joint_dims[0]] += upright * (stations[0].bearing - nominal.down.bearing)
            solution = self._solved(arm, stations, np.clip(turned, self._robot.lower, self._robot.upper))
            if solution is not None:
                return solution
        return self._solved(arm, stations, start, list(nominal.down.interpolate(stations[0])))

    def _solved(
        self, arm: Group, stations: Sequence[DownwardTip], seed: Float64, before: Sequence[DownwardTip] = ()
    ) -> Float64 | None:
        """Return joints [T, D] for the stations, solved after the poses `before`; None if a station is not reached."""
        index = self._robot.arms.index(arm)
        frame = self._limbs[arm.name].frame(seed)
        tip = np.eye(4) if arm.tip is None else arm.tip
        eef = (
            np.linalg.inv(frame)
            @ np.stack([down.tip() for down in (*before, *stations)])
            @ np.linalg.inv(tip)
        )
        targets = np.repeat(self._kinematics.forward(seed)[None], len(eef), axis=0)
        targets[:, index, :3] = eef[:, :3, 3]
        targets[:, index, 3:] = quaternion_of_matrix(eef[:, :3, :3])
        result = self._kinematics.solve(targets, seed)
        return result.q[len(before) :] if result.reached[len(before) :, index].all() else None

    def _learn(self, arm: Group) -> str:
        """Find and store the nominal posture of an arm; return the reason if there is none, else ""."""
        if arm.tip is None or arm.gripper is None or arm.gripper.apart is None:
            return f"{arm.name} needs fingertips and a gripper that says how far it opens (apart)"
        places = self._arm_places(arm)
        best, reached = None, 0
        for nominal in self._search_postures(arm):
            count = sum(self._reaches(arm, nominal, place) for place in places)
            if best is None or count > reached:
                best, reached = nominal, count
            if reached >= _ENOUGH * len(places):
                break
        if best is None:
            return f"{arm.name} cannot hold its fingertips down {CLEAR} m above the table"
        self._nominal[arm.name] = best
        return ""

    def _search_postures(self, arm: Group) -> Iterator[Nominal]:
        """Yield postures with the fingertips down, found from the rest posture, then from increasingly random seeds."""
        chance = np.random.default_rng(0)
        seed = self._rest
        low, high = np.maximum(self._robot.lower, -math.pi), np.minimum(self._robot.upper, math.pi)
        for number in range(_TRIES):
            for place in self._ahead(arm):
                bearing = self._bearing(arm, place)
                for across in (_ACROSS, -_ACROSS):
                    down = DownwardTip(place, CLEAR, bearing + across, bearing, TILTS[0][1])
                    solution = self._solved(arm, [down], seed)
                    if solution is not None:
                        yield Nominal(solution[0, arm.joint_dims], down, across)
            share = min(1.0, 2 * (number + 1) / _TRIES)
            seed = np.clip(
                (1 - share) * self._rest + share * chance.uniform(low, high),
                self._robot.lower,
                self._robot.upper,
            )

    def _reaches(self, arm: Group, nominal: Nominal, place: Place) -> bool:
        """Return True if the fingertips can go straight down at a place of the table."""
        bearing = self._bearing(arm, place)
        low = _GRASP * self._table.block_edge
        above = DownwardTip(place, CLEAR, bearing + nominal.across, bearing, TILTS[0][1])
        below = replace(above, height=low, tilt=TILTS[0][0])
        return self._descent(arm, self._rest, nominal, [above, below]) is not None

    def _arm_places(self, arm: Group) -> list[Place]:
        """Return the places of the area that are nearer to this arm than to any other."""
        x_from, x_to, y_from, y_to = self._table.area
        places = [
            (float(x), float(y)) for x in np.linspace(x_from, x_to, 5) for y in np.linspace(y_from, y_to, 3)
        ]
        return [
            place
            for place in places
            if self.distance(arm, place)
            <= min(self.distance(any_arm, place) for any_arm in self._robot.arms) + 1e-6
        ]

    def _ahead(self, arm: Group) -> list[Place]:
        """Return the places where searches start: straight ahead of the shoulder, and the middle of the area."""
        x_from, x_to, y_from, y_to = self._table.area
        x, y = self._shoulders[arm.name]
        ahead = (
            float(np.clip(x, x_from - _ASIDE, x_to + _ASIDE)),
            float(np.clip(y + _AHEAD, y_from, y_to)),
        )
        return [ahead, ((x_from + x_to) / 2, (y_from + y_to) / 2)]

    def _bearing(self, arm: Group, place: Place) -> float:
        x, y = self._shoulders[arm.name]
        return math.atan2(place[1] - y, place[0] - x)


def jaws(arm: Group) -> Gripper:
    """Return the description of an arm's gripper."""
    assert arm.gripper is not None  # arms without a gripper are excluded in _learn
    return arm.gripper


def opened(arm: Group, q: Float64) -> Float64:
    """Return joints [..., D] with an arm's jaws open, but not up to their limit, near which safety slows them."""
    return q.copy() if arm.gripper is None else _with_jaws(arm, q, jaws(arm).open, jaws(arm).close)


def closed(arm: Group, q: Float64) -> Float64:
    """Return joints [..., D] with an arm's jaws closed, but not up to their limit."""
    return q.copy() if arm.gripper is None else _with_jaws(arm, q, jaws(arm).close, jaws(arm).open)


def gripper_dim(arm: Group) -> int:
    """Return the dimension of an arm's gripper in the robot's vector."""
    assert arm.gripper_dim is not None
    return arm.gripper_dim


def _with_jaws(arm: Group, q: Float64, start: float, end: float) -> Float64:
    changed = q.copy()
    changed[..., gripper_dim(arm)] = start + _MARGIN * (end - start)
    return changed
