"""Errors and flags of solved joints, independent of the backend."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robots import Group, Robot
from robots.rotations import rotation_vector, transform_of
from runtime.core.types import Float64
from runtime.kinematics.base import IkFlag, IkResult, KinematicsSettings

_RESTS = 1e-6  # [rad, m] distance from a bound that counts as on it


def evaluate_solution(
    robot: Robot, settings: KinematicsSettings, q: Float64, targets: Float64, bounds: tuple[Float64, Float64]
) -> IkResult:
    """Return the result for joints q [T, D] that were solved for poses [T, arms, 7].

    `bounds` are the lowest and highest joints [T, D] of each frame, from joint limits and velocities.
    """
    shape = (len(q), len(robot.arms))
    position, rotation, flags = np.empty(shape), np.empty(shape), np.zeros(shape, dtype=np.uint8)
    for index, arm in enumerate(robot.arms):
        reached, target = arm.transform(q), transform_of(targets[:, index])
        position[:, index] = np.linalg.norm(reached[:, :3, 3] - target[:, :3, 3], axis=-1)
        apart = rotation_vector(target[:, :3, :3] @ np.swapaxes(reached[:, :3, :3], -1, -2))
        rotation[:, index] = np.linalg.norm(apart, axis=-1)
        flags[:, index] = _bound(robot, arm, q, bounds)
        flags[:, index] |= _singular(arm, q, settings.singular_below)
    over = (position > settings.position_tolerance) | (rotation > settings.rotation_tolerance)
    flags[over] |= int(IkFlag.OVER_TOLERANCE)
    return IkResult(q, position, rotation, flags)


def _bound(robot: Robot, arm: Group, q: Float64, bounds: tuple[Float64, Float64]) -> NDArray[np.uint8]:
    dims = arm.joint_dims
    own, low, high = q[:, dims], bounds[0][:, dims], bounds[1][:, dims]
    at_limit = (own <= robot.lower[dims] + _RESTS) | (own >= robot.upper[dims] - _RESTS)
    at_velocity = ~at_limit & ((own <= low + _RESTS) | (own >= high - _RESTS))
    flags = np.zeros(len(q), dtype=np.uint8)
    flags[at_limit.any(axis=1)] |= int(IkFlag.AT_LIMIT)
    flags[at_velocity.any(axis=1)] |= int(IkFlag.AT_VELOCITY)
    return flags


def _singular(arm: Group, q: Float64, below: float) -> NDArray[np.uint8]:
    assert arm.chain is not None  # it is an arm
    smallest = [
        np.linalg.svd(arm.chain.jacobian(row)[1], compute_uv=False)[-1] for row in q[:, arm.joint_dims]
    ]
    flags = np.zeros(len(q), dtype=np.uint8)
    flags[np.array(smallest) < below] = int(IkFlag.NEAR_SINGULAR)
    return flags
