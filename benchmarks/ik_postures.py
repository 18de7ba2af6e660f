"""Drift of postures: joints after loops of the same circle, and long paths that joints are known to have."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.ik_paths import ROWS, arm_dims
from robots import Robot
from runtime.kinematics.base import IkResult, Kinematics

RADIUS = 0.05  # m of the circles, which begin and end at home
LOOPS = 12
SETTLED = 2  # loops after which the joints are to come back to where they were
PATHS = 30
LEGS = 3
_LOOP_S = 4.0
_PLANES = ((0, 1), (1, 2), (0, 2))
_HURRY = 0.4  # of a joint's speed limit is the most that a path asks for
_ROOM = 0.05  # rad (m) that paths keep from limits
_LEG = 1.0  # rad (m) that a joint moves on a leg at most, where legs are short
_ENDLESS = 3.0  # rad to either side in which joints without limits are moved

Float64 = NDArray[np.float64]


def redundant(robot: Robot) -> bool:
    """True if an arm has more joints than a pose holds."""
    return any(len(arm.joint_dims) > 6 for arm in robot.arms)


def followed(kinematics: Kinematics, robot: Robot, targets: Float64, start: Float64, rows: int) -> IkResult:
    """Poses [T, arms, 7] in chunks of `rows`, each from the last command of the one before."""
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
    """rad [planes, LOOPS]: by how much the joints differ from the end of one loop to that of the next, at most."""
    home, dims = robot.poses["home"], arm_dims(robot)
    rows = round(_LOOP_S * robot.control_rate)
    angles = np.tile(np.arange(1, rows + 1) / rows * 2 * math.pi, LOOPS)
    found = []
    for first, second in _PLANES:
        targets = np.repeat(kinematics.forward(home)[None], len(angles), axis=0)
        targets[..., first] += RADIUS * (np.cos(angles) - 1)[:, None]
        targets[..., second] += RADIUS * np.sin(angles)[:, None]
        q = followed(kinematics, robot, targets, home, ROWS).q
        ends = np.concatenate([home[None], q[rows - 1 :: rows]])[:, dims]
        found.append(np.abs(np.diff(ends, axis=0)).max(axis=1))
    return np.stack(found)


def path(robot: Robot, number: int, legs: int = LEGS, leg: float = _LEG) -> Float64:
    """Joints [T, D] over random postures, easing in and out of each; the same ones for the same number."""
    chance, dims = np.random.default_rng([0, number]), arm_dims(robot)
    low = np.maximum(robot.lower + _ROOM, -_ENDLESS)[dims]
    high = np.minimum(robot.upper - _ROOM, _ENDLESS)[dims]
    at = robot.poses["home"].copy()
    at[dims] = chance.uniform(low, high)
    rows = [at[None]]
    for _ in range(legs):
        way = np.zeros(robot.dim)
        way[dims] = chance.uniform(low, high) - at[dims]
        way *= min(1.0, leg / np.abs(way).max())
        seconds = (np.abs(way[dims]) * math.pi / 2 / (_HURRY * robot.velocity[dims])).max()
        count = max(2, math.ceil(seconds * robot.control_rate))
        eased = (1 - np.cos(np.linspace(0, math.pi, count + 1)[1:])) / 2
        rows.append(at + eased[:, None] * way)
        at = at + way
    return np.concatenate(rows)


def worst(robot: Robot, kinematics: Kinematics, joints: Float64, rows: int | None = None) -> Float64:
    """m [arms]: how far off the poses of a joint path [T, D] are at most, in chunks of `rows` or in one."""
    targets = kinematics.forward(joints)
    missed: Float64 = followed(kinematics, robot, targets, joints[0], rows or len(joints)).position_error.max(
        axis=0
    )
    return missed
