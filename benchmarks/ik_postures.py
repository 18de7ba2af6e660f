"""Drift of postures: joints after repeated circles, and long paths with known joints."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.ik_paths import ROWS, arm_dims
from robots import Robot
from runtime.kinematics.base import IkResult, Kinematics

RADIUS = 0.05  # [m] radius of the circles, which begin and end at home
LOOPS = 12
SETTLED = 2  # loops after which joints should return to the same values
PATHS = 30
LEGS = 3
_LOOP_S = 4.0
_PLANES = ((0, 1), (1, 2), (0, 2))
_HURRY = 0.4  # largest share of a joint's speed limit that a path requires
_ROOM = 0.05  # [rad, m] margin of paths to limits
_LEG = 1.0  # [rad, m] largest motion of a joint per short leg
_ENDLESS = 3.0  # [rad] range to either side of joints without limits

Float64 = NDArray[np.float64]


def redundant(robot: Robot) -> bool:
    """Return True if an arm has more than six joints."""
    return any(len(arm.joint_dims) > 6 for arm in robot.arms)


def followed(kinematics: Kinematics, robot: Robot, targets: Float64, start: Float64, rows: int) -> IkResult:
    """Return the joints solved for poses [T, arms, 7] in chunks of `rows`, each from the end of the previous chunk."""
    dt, at, parts = 1 / robot.control_rate, start, []
    for begin in range(0, len(targets), rows):
        parts.append(kinematics.solve(targets[begin : begin + rows], at, dt, at, 0))
        at = parts[-1].q[-1]
    return IkResult(
        np.concatenate([part.q for part in parts]),
        np.concatenate([part.position_error for part in parts]),
        np.concatenate([part.rotation_error for part in parts]),
        np.concatenate([part.flags for part in parts]),
    )


def drift(robot: Robot, kinematics: Kinematics) -> Float64:
    """Return the largest difference of the joints between the ends of consecutive loops, rad [planes, LOOPS]."""
    home, dims = robot.poses["home"], arm_dims(robot)
    rows = round(_LOOP_S * robot.control_rate)
    angles = np.tile(np.arange(1, rows + 1) / rows * 2 * math.pi, LOOPS)
    steps = []
    for first, second in _PLANES:
        targets = np.repeat(kinematics.forward(home)[None], len(angles), axis=0)
        targets[..., first] += RADIUS * (np.cos(angles) - 1)[:, None]
        targets[..., second] += RADIUS * np.sin(angles)[:, None]
        q = followed(kinematics, robot, targets, home, ROWS).q
        ends = np.concatenate([home[None], q[rows - 1 :: rows]])[:, dims]
        steps.append(np.abs(np.diff(ends, axis=0)).max(axis=1))
    return np.stack(steps)


def path(robot: Robot, number: int, legs: int = LEGS, leg: float = _LEG) -> Float64:
    """Return joints [T, D] that move smoothly through a sequence of random postures.

    The path depends only on the robot, `number`, and the number and length of its legs.
    """
    chance, dims = np.random.default_rng([0, number]), arm_dims(robot)
    low = np.maximum(robot.lower + _ROOM, -_ENDLESS)[dims]
    high = np.minimum(robot.upper - _ROOM, _ENDLESS)[dims]
    at = robot.poses["home"].copy()
    at[dims] = chance.uniform(low, high)
    rows = [at[None]]
    for _ in range(legs):
        travel = np.zeros(robot.dim)
        travel[dims] = chance.uniform(low, high) - at[dims]
        travel *= min(1.0, leg / np.abs(travel).max())
        seconds = (np.abs(travel[dims]) * math.pi / 2 / (_HURRY * robot.velocity[dims])).max()
        count = max(2, math.ceil(seconds * robot.control_rate))
        eased = (1 - np.cos(np.linspace(0, math.pi, count + 1)[1:])) / 2
        rows.append(at + eased[:, None] * travel)
        at = at + travel
    return np.concatenate(rows)


def worst(robot: Robot, kinematics: Kinematics, joints: Float64, rows: int | None = None) -> Float64:
    """Return the largest position error [m] of each arm along a joint path [T, D], as [arms].

    The path is solved in chunks of `rows` rows; in a single chunk if `rows` is None.
    """
    targets = kinematics.forward(joints)
    missed: Float64 = followed(kinematics, robot, targets, joints[0], rows or len(joints)).position_error.max(
        axis=0
    )
    return missed
