"""Chunks of end-effector poses to solve: smooth ones, through singular postures, out of reach, and recorded ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet
from numpy.typing import NDArray

from robots import Group, Robot

ROWS = 50
CHUNKS = 8  # of each kind: the same chunk again and again would flatter the branch predictor
_UNHURRIED = 0.4  # of a joint's speed limit is the most that a path asks for
_TURN = 1.0  # rad (m) that a joint moves in a chunk at most
_BEYOND = 1.2  # m that targets out of reach go, outwards
_SEARCHES = 400
_ENDLESS = 3.0  # rad to either side in which joints without limits are moved

Float64 = NDArray[np.float64]
Solvable = Callable[[Float64], Float64]  # poses of joints


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Targets [T, arms, 7] for rows `dt` apart, and the joints [D] they are solved from."""

    targets: Float64
    seed: Float64
    dt: float


def invented(robot: Robot) -> dict[str, list[Chunk]]:
    """Chunks of every kind for any robot; `smooth` and `singular` ones come from joint paths and can be reached."""
    chance = np.random.default_rng(5)
    dt = 1 / robot.control_rate
    made: dict[str, list[Chunk]] = {"smooth": [], "singular": [], "out_of_reach": []}
    for _ in range(CHUNKS):
        start, end = _within(robot, chance, 0.25), _within(robot, chance, 0.25)
        path = _path(robot, start, end, dt)
        made["smooth"].append(Chunk(_poses(robot, path), path[0], dt))
        far = np.repeat(_poses(robot, path[:1]), ROWS, axis=0)
        far[..., :3] += np.linspace(0, _BEYOND, ROWS)[:, None, None] * _outwards(far[0, :, :3])
        made["out_of_reach"].append(Chunk(far, path[0], dt))
        through = _singular(robot, chance)
        path = _path(robot, *_ends_around(robot, through, _within(robot, chance, 0.05)), dt)
        made["singular"].append(Chunk(_poses(robot, path), path[0], dt))
    return made


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A recorded episode: joints [T, D] and poses [T, arms, 7] that the robot measured at the same time."""

    joints: Float64
    poses: Float64

    def chunks(self, dt: float) -> list[Chunk]:
        """All of it, each chunk from the joints that were measured at its first row."""
        starts = range(0, len(self.joints) - ROWS + 1, ROWS)
        return [Chunk(self.poses[at : at + ROWS], self.joints[at], dt) for at in starts]


def recorded(folder: Path) -> Recording:
    """The first episode of a LeRobot dataset with joints and poses of two arms."""
    file = min(folder.glob("data/*/*.parquet"))
    table = pyarrow.parquet.read_table(file, columns=["observation.qpos", "observation.eef"])
    joints, eef = (np.array(column.to_pylist(), dtype=np.float64) for column in table.columns)
    return Recording(joints, np.ascontiguousarray(eef.reshape(len(eef), -1, 8)[..., :7]))


def arm_dims(robot: Robot) -> NDArray[np.intp]:
    """The places of all joints that kinematics solves."""
    return np.concatenate([arm.joint_dims for arm in robot.arms])


def _poses(robot: Robot, path: Float64) -> Float64:
    return np.stack([arm.pose(path) for arm in robot.arms], axis=1)


def _bounds(robot: Robot) -> tuple[Float64, Float64]:
    return np.maximum(robot.lower, -_ENDLESS), np.minimum(robot.upper, _ENDLESS)


def _within(robot: Robot, chance: np.random.Generator, margin: float) -> Float64:
    """A posture whose arm joints keep a margin [share of their range] from limits; all else as at home."""
    low, high = _bounds(robot)
    posture = robot.poses["home"].copy()
    dims = arm_dims(robot)
    posture[dims] = (low + chance.uniform(margin, 1 - margin, robot.dim) * (high - low))[dims]
    return posture


def _path(robot: Robot, start: Float64, end: Float64, dt: float) -> Float64:
    """Joints [T, D] that speed up and slow down from `start` towards `end`, as far as is unhurried."""
    way = end - start
    dims = arm_dims(robot)
    steepest = math.pi / 2 / (dt * (ROWS - 1))
    rush = np.abs(way[dims]) * steepest / (_UNHURRIED * robot.velocity[dims])
    share = 1 / max(1.0, rush.max(), np.abs(way).max() / _TURN)
    eased = (1 - np.cos(np.linspace(0, math.pi, ROWS))) / 2
    return start + eased[:, None] * share * way


def _outwards(points: Float64) -> Float64:
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def _singular(robot: Robot, chance: np.random.Generator) -> Float64:
    """A posture in which every arm has a direction that it can hardly move in, found by trying."""
    low, high = _bounds(robot)
    posture = _within(robot, chance, 0.1)
    for arm in robot.arms:
        best, reach = _smallest(arm, posture), 0.5
        for _ in range(_SEARCHES):
            tried = posture.copy()
            tried[arm.joint_dims] += chance.normal(0, reach, len(arm.joint_dims))
            tried = np.clip(tried, low + 0.1 * (high - low), high - 0.1 * (high - low))
            found = _smallest(arm, tried)
            if found < best:
                posture, best = tried, found
            else:
                reach = max(1e-3, 0.99 * reach)
    return posture


def _smallest(arm: Group, posture: Float64) -> float:
    assert arm.chain is not None  # it is an arm
    return float(np.linalg.svd(arm.chain.jacobian(posture[arm.joint_dims])[1], compute_uv=False)[-1])


def _ends_around(robot: Robot, middle: Float64, towards: Float64) -> tuple[Float64, Float64]:
    """Two postures with `middle` halfway between them, both within the limits."""
    low, high = _bounds(robot)
    way = np.minimum(np.abs(towards - middle), np.minimum(middle - low, high - middle)) * np.sign(
        towards - middle
    )
    way = np.minimum(np.abs(way), _TURN / 2) * np.sign(way)
    return middle - way, middle + way
