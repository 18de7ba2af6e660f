"""Where an arm's joints are for its fingertips over a block or a plate, pointing down.

Four points of every vertical way are solved by inverse kinematics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

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
TILTS = ((0.0, 0.26), (0.26, 0.26), (0.4, 0.4))  # rad outwards from straight down: below, above
_GRASP = 0.45  # of the block's edge: the height of the fingertips that grasp it
_DROP = 0.003  # m between block and plate when the jaws open
_MARGIN = 0.05  # of the jaws' whole way, at both ends
_AHEAD = 0.3  # m from an arm's base to the place over which searches begin
_TRIES = 200
_STATIONS = 4
_ACROSS = math.pi / 2

Place = tuple[float, float]
Tilts = tuple[float, float]


class Postures:
    """Those of one robot at one bench; SetupError where an arm of it cannot pick things up."""

    def __init__(self, robot: Robot, table: Bench) -> None:
        self._robot = robot
        self._table = table
        self._kinematics = NumericKinematics(robot)
        self._rest = robot.poses.get("ready", robot.poses["home"])
        self._nominal = {arm.name: self._search(arm) for arm in robot.arms}

    def hover(self, arm: Group, q: Float64, place: Place, height: float) -> Float64 | None:
        """Joints [D] with an arm's fingertips over a place at a height, its jaws open; None where it cannot reach."""
        tilt = TILTS[0][1]
        way = self._down(arm, q, place, 0.0, (height, CLEAR), (tilt, tilt))
        return None if way is None else np.asarray(way[-1])

    def stations(
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
        low = _GRASP * self._table.block_edge
        put = self._table.plate_height + low + _DROP
        down = self._down(arm, q, (x, y), twist, (low, CLEAR), tilts)
        return down, down if down is None else self._down(arm, q, plate, twist, (put, CLEAR), tilts)

    def risen(self, arm: Group, q: Float64) -> Float64:
        """Joints [D] with the fingertips straight up from where they are; q where they are high or cannot."""
        tip = bench.tip_in_world(arm, q)
        if tip[2, 3] >= CLEAR:
            return q
        place = float(tip[0, 3]), float(tip[1, 3])
        yaw, bearing = math.atan2(tip[1, 1], tip[0, 1]), self._bearing(arm, place)
        for _, tilt in TILTS:
            found = self._solved(arm, [_tip(place, CLEAR, yaw, bearing, tilt)], q)
            if found is not None:
                return np.asarray(found[0])
        return q

    def rested(self, arm: Group, q: Float64) -> Float64:
        """Joints [D] with an arm at rest, its jaws open."""
        rest = q.copy()
        rest[arm.slice] = self._rest[arm.slice]
        return opened(arm, rest)

    def _down(
        self, arm: Group, q: Float64, place: Place, twist: float, heights: tuple[float, float], tilts: Tilts
    ) -> Float64 | None:
        """Joints [stations, D] of an arm with open jaws, the others as in q [D]; None where it cannot reach."""
        bearing = self._bearing(arm, place)
        seed, across = self._nominal[arm.name]
        start = opened(arm, q)
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
                tip = _tip(place, CLEAR, bearing + across, bearing, TILTS[0][1])
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


def jaws(arm: Group) -> Gripper:
    """The gripper of an arm."""
    assert arm.gripper is not None  # an arm is a group with a gripper
    return arm.gripper


def gripper_dim(arm: Group) -> int:
    """The place of an arm's gripper in the robot's vector."""
    assert arm.gripper_dim is not None
    return arm.gripper_dim


def opened(arm: Group, q: Float64) -> Float64:
    """Joints [..., D] with an arm's jaws open: nearly as far as they go, because safety slows them at their limits."""
    return _with_jaws(arm, q, jaws(arm).open + _MARGIN * (jaws(arm).close - jaws(arm).open))


def closed(arm: Group, q: Float64) -> Float64:
    """Joints [..., D] with an arm's jaws closed, likewise."""
    return _with_jaws(arm, q, jaws(arm).close + _MARGIN * (jaws(arm).open - jaws(arm).close))


def _with_jaws(arm: Group, q: Float64, opening: float) -> Float64:
    changed = q.copy()
    changed[..., gripper_dim(arm)] = opening
    return changed


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
