"""Chunks of end-effector poses: smooth, near and through singularities, out of reach, and recorded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet
from numpy.typing import NDArray

from robots import Group, Robot

ROWS = 50
OUT_OF_REACH = "out_of_reach"
CHUNKS = 8  # chunks per kind; repeating one chunk would favour the branch predictor
_UNHURRIED = 0.4  # largest share of a joint's speed limit that a path requires
_TURN = 1.0  # [rad, m] largest motion of a joint per chunk
_BEYOND = 1.2  # [m] distance of unreachable targets, outwards
_NEAR = 0.01  # smallest singular value of `singular` chunks
_SEARCHES = 400
_ENDLESS = 3.0  # [rad] range to either side of joints without limits

Float64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Poses [T, arms, 7] to solve, in rows `dt` [s] apart.

    `seed` [D] are the joints to start from; `reachable` is True if joints exist for all poses.
    """

    targets: Float64
    seed: Float64
    dt: float
    reachable: bool


def invented(robot: Robot) -> dict[str, list[Chunk]]:
    """Return chunks of every kind for a robot, by the name of the kind.

    Except for those out of reach, the chunks are poses along a slow joint path. Chunks of kind `singular` approach a
    singularity in the middle, those of kind `through` pass through it.
    """
    chance = np.random.default_rng(5)
    kinds = ("smooth", "singular", "through", OUT_OF_REACH)
    chunks: dict[str, list[Chunk]] = {kind: [] for kind in kinds}
    for _ in range(CHUNKS):
        path = _path(robot, _within(robot, chance, 0.25), _within(robot, chance, 0.25))
        chunks["smooth"].append(_chunk(robot, path))
        chunks[OUT_OF_REACH].append(_leaving(_chunk(robot, path)))
        for kind, smallest in (("singular", _NEAR), ("through", 0.0)):
            middle = _with_singular_value(robot, chance, smallest)
            ends = _ends_around(robot, middle, _within(robot, chance, 0.05))
            chunks[kind].append(_chunk(robot, _path(robot, *ends)))
    return chunks


def _chunk(robot: Robot, path: Float64) -> Chunk:
    poses = np.stack([arm.pose(path) for arm in robot.arms], axis=1)
    return Chunk(poses, path[0], 1 / robot.control_rate, True)


def _leaving(chunk: Chunk) -> Chunk:
    """Return a chunk from the same start that moves away from the arms' bases until it is out of reach."""
    first = chunk.targets[0, :, :3]
    targets = np.repeat(chunk.targets[:1], ROWS, axis=0)
    outwards = first / np.linalg.norm(first, axis=-1, keepdims=True)
    targets[..., :3] += np.linspace(0, _BEYOND, ROWS)[:, None, None] * outwards
    return Chunk(targets, chunk.seed, chunk.dt, False)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Recorded episode: joints [T, D] and poses [T, arms, 7] that the robot measured simultaneously."""

    joints: Float64
    poses: Float64

    def chunks(self, robot: Robot) -> list[Chunk]:
        """Return the whole recording as chunks, each starting from the joints measured at its first row."""
        rows = [slice(at, at + ROWS) for at in range(0, len(self.joints) - ROWS + 1, ROWS)]
        return [Chunk(self.poses[row], self.joints[row.start], 1 / robot.control_rate, True) for row in rows]


def recorded(folder: Path) -> Recording:
    """Return the first episode of a LeRobot dataset with joints and poses of two arms."""
    file = min(folder.glob("data/*/*.parquet"))
    table = pyarrow.parquet.read_table(file, columns=["observation.qpos", "observation.eef"])
    joints, eef = (np.array(column.to_pylist(), dtype=np.float64) for column in table.columns)
    return Recording(joints, np.ascontiguousarray(eef.reshape(len(eef), -1, 8)[..., :7]))


def arm_dims(robot: Robot) -> NDArray[np.intp]:
    """Return the indices of all joints that kinematics solves."""
    return np.concatenate([arm.joint_dims for arm in robot.arms])


def _bounds(robot: Robot) -> tuple[Float64, Float64]:
    return np.maximum(robot.lower, -_ENDLESS), np.minimum(robot.upper, _ENDLESS)


def _within(robot: Robot, chance: np.random.Generator, margin: float) -> Float64:
    """Return a random posture whose arm joints are at least `margin` (a share of their range) from limits; other joints
    are at home.
    """
    low, high = _bounds(robot)
    posture = robot.poses["home"].copy()
    dims = arm_dims(robot)
    posture[dims] = (low + chance.uniform(margin, 1 - margin, robot.dim) * (high - low))[dims]
    return posture


def _path(robot: Robot, start: Float64, end: Float64) -> Float64:
    """Return joints [T, D] that accelerate from `start` towards `end` and decelerate, as far as speed limits allow."""
    travel = end - start
    dims = arm_dims(robot)
    steepest = math.pi / 2 * robot.control_rate / (ROWS - 1)
    rush = np.abs(travel[dims]) * steepest / (_UNHURRIED * robot.velocity[dims])
    share = 1 / max(1.0, rush.max(), np.abs(travel).max() / _TURN)
    eased = (1 - np.cos(np.linspace(0, math.pi, ROWS))) / 2
    path: Float64 = start + eased[:, None] * share * travel
    return path


def _with_singular_value(robot: Robot, chance: np.random.Generator, target: float) -> Float64:
    """Return a posture in which the Jacobian of every arm has nearly the smallest singular value `target`.

    It is found by random search.
    """
    low, high = _bounds(robot)
    low, high = low + 0.1 * (high - low), high - 0.1 * (high - low)
    posture = _within(robot, chance, 0.1)
    for arm in robot.arms:
        best, reach = abs(_smallest(arm, posture) - target), 0.5
        for _ in range(_SEARCHES):
            tried = posture.copy()
            tried[arm.joint_dims] += chance.normal(0, reach, len(arm.joint_dims))
            tried = np.clip(tried, low, high)
            off = abs(_smallest(arm, tried) - target)
            if off < best:
                posture, best = tried, off
            else:
                reach = max(1e-3, 0.99 * reach)
    return posture


def _smallest(arm: Group, posture: Float64) -> float:
    assert arm.chain is not None  # it is an arm
    return float(np.linalg.svd(arm.chain.jacobian(posture[arm.joint_dims])[1], compute_uv=False)[-1])


def _ends_around(robot: Robot, middle: Float64, towards: Float64) -> tuple[Float64, Float64]:
    """Return two postures within the limits that have `middle` halfway between them."""
    low, high = _bounds(robot)
    half_travel = np.minimum(np.abs(towards - middle), np.minimum(middle - low, high - middle)) * np.sign(
        towards - middle
    )
    half_travel = np.minimum(np.abs(half_travel), _TURN / 2) * np.sign(half_travel)
    return middle - half_travel, middle + half_travel
