"""A whole chunk: all frames of all arms, each frame from the one before."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from runtime.kinematics.kernels.chains import frames_of
from runtime.kinematics.kernels.compiling import kernel, part
from runtime.kinematics.kernels.frames import Costs, Room, near_singular, room_for, solve_frame
from runtime.kinematics.kernels.rotations import matrix_of
from runtime.kinematics.kernels.sizes import Size
from runtime.kinematics.tables import ChainTables
from runtime.types import Float64, UInt8

FINE, NOT_FINITE, NO_QUATERNION = 0, 1, 2
_OVER_TOLERANCE, _AT_LIMIT, _AT_VELOCITY, _NEAR_SINGULAR = 1, 2, 4, 8  # runtime.kinematics.base.IkFlag
_TOUCHING = 1e-9  # rad (m) from a limit: on it
_WITHIN = 1 - 1e-9  # of the way that a velocity allows is used, so that rounding never exceeds it
_FOLLOWED = 1e-6  # weighted squared error (20 um) up to which a frame's motion is worth going on with
_KEPT = 0.9  # of a motion is what a frame rests on: what poses leave open dies away within some ten frames
_SHORTEST = 1e-12  # square of a quaternion's length


class Arms(NamedTuple):
    """Chains whose joints are solved: own ones [A], each at the end of its carrier, and their limits."""

    own: ChainTables  # driven by the arm's own numbers, 0 to n - 1
    carriers: ChainTables  # driven by the robot's vector
    sizes: np.ndarray  # int64 [A]: how many numbers drive each; the rest of n stands still
    dims: np.ndarray  # int64 [A, n]: their places in the robot's vector
    lower: Float64  # [A, n]
    upper: Float64
    speed: Float64  # rad/s (m/s)


class Tolerances(NamedTuple):
    """When a frame counts as reached, and when as near singular."""

    position: float
    rotation: float
    singular_below: float


class Asked(NamedTuple):
    """What a chunk is to be solved for."""

    targets: Float64  # [T, A, 7]
    seed: Float64  # [1, D]
    dt: float  # s between frames; 0 for no velocity limit
    anchor: Float64  # [D]
    anchor_row: int  # -1 for no anchor


class Solved(NamedTuple):
    """What a chunk's solution is written into."""

    q: Float64  # [T, D]
    position_error: Float64  # [T, A]
    rotation_error: Float64
    flags: UInt8


class _Frame(NamedTuple):
    """One frame of one arm while it is solved; joints are [n]."""

    goal: Float64  # [12]
    q: Float64
    begin: Float64  # where it begins: the frame before, within the box
    centre: Float64  # what it rests on
    before: Float64  # what its velocity counts from
    motion: Float64  # of the frame before
    low: Float64
    high: Float64


@kernel
def solve_chunk(
    moving: Size,
    carrying: Size,
    size: Size,
    arms: Arms,
    costs: Costs,
    tolerances: Tolerances,
    asked: Asked,
    solved: Solved,
) -> int:
    """Fills `solved`; FINE, or what is wrong with the numbers that were asked."""
    wrong = _wrong(asked)
    if wrong != FINE:
        return wrong
    n = len(size)
    room = room_for(moving, size)
    frame = _Frame(
        np.empty(12),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
    )
    turns, base = np.empty((3, len(carrying))), np.empty((len(carrying) + 1, 12))
    for row in range(len(asked.targets)):
        for dim in range(asked.seed.shape[1]):
            solved.q[row, dim] = asked.seed[0, dim]
    for arm in range(asked.targets.shape[1]):
        frames_of(carrying, arm, arms.carriers, asked.seed, 0, turns, base)
        _follow(moving, size, arm, arms, costs, tolerances, asked, base[len(carrying)], frame, room, solved)
    return FINE


@part
def _wrong(asked: Asked) -> int:
    for number in asked.targets.flat:
        if not math.isfinite(number):
            return NOT_FINITE
    for dim in range(len(asked.anchor)):
        if not math.isfinite(asked.seed[0, dim]) or not math.isfinite(asked.anchor[dim]):
            return NOT_FINITE
    for row in range(len(asked.targets)):
        for arm in range(asked.targets.shape[1]):
            square = 0.0
            for k in range(3, 7):
                square += asked.targets[row, arm, k] ** 2
            if square < _SHORTEST:
                return NO_QUATERNION
    return FINE


@part
def _follow(
    moving: Size,
    size: Size,
    arm: int,
    arms: Arms,
    costs: Costs,
    tolerances: Tolerances,
    asked: Asked,
    base: Float64,
    frame: _Frame,
    room: Room,
    solved: Solved,
) -> None:
    """All frames of one arm; `base` [12] is where its own chain begins.

    A frame whose predecessor met its target is searched from where that one's motion leads, and rests on most of
    that motion: on a smooth path one step is then enough, and where branches meet (at a singularity) it goes straight on.
    """
    n = len(size)
    for i in range(n):
        there = asked.seed[0, arms.dims[arm, i]] if i < arms.sizes[arm] else 0.0
        frame.q[i] = min(max(there, arms.lower[arm, i]), arms.upper[arm, i])
    bound, going = False, False
    for row in range(len(asked.targets)):
        if row == asked.anchor_row:
            bound, going = True, False
            for i in range(arms.sizes[arm]):
                frame.before[i] = asked.anchor[arms.dims[arm, i]]
        _wall_in(size, arm, arms, asked.dt if bound else 0.0, frame)
        for i in range(n):
            frame.begin[i] = min(max(frame.q[i], frame.low[i]), frame.high[i])
            frame.q[i] = frame.centre[i] = frame.begin[i]
            if going:
                frame.centre[i] += _KEPT * frame.motion[i]
                frame.q[i] = min(max(frame.q[i] + frame.motion[i], frame.low[i]), frame.high[i])
        _goal_of(asked.targets, row, arm, base, frame.goal)
        error = solve_frame(
            moving, size, arm, arms.own, costs, frame.goal, frame.centre, frame.low, frame.high, frame.q, room
        )
        _tell(size, row, arm, arms, costs, tolerances, error, asked.dt if bound else 0.0, frame, room, solved)
        missed = 0.0
        for k in range(6):
            missed += error[k] * error[k]
        going = missed <= _FOLLOWED
        bound = row >= asked.anchor_row
        for i in range(n):
            frame.motion[i] = frame.q[i] - frame.begin[i]
            frame.before[i] = frame.q[i]


@part
def _wall_in(size: Size, arm: int, arms: Arms, dt: float, frame: _Frame) -> None:
    """The box of a frame: its limits, and, where dt is given, what the velocities leave of them around `before`."""
    for i in range(len(size)):
        lower, upper = arms.lower[arm, i], arms.upper[arm, i]
        frame.low[i], frame.high[i] = lower, upper
        if dt > 0:
            way = _WITHIN * arms.speed[arm, i] * dt
            frame.before[i] = min(max(frame.before[i], lower), upper)
            frame.low[i] = max(lower, frame.before[i] - way)
            frame.high[i] = min(upper, frame.before[i] + way)


@part
def _goal_of(targets: Float64, row: int, arm: int, base: Float64, goal: Float64) -> None:
    """Into `goal` [12] the target as it is seen from `base` [12]."""
    wanted = targets[row, arm]
    matrix_of(wanted[3:], goal)
    x, y, z = wanted[0] - base[9], wanted[1] - base[10], wanted[2] - base[11]
    for i in range(3):
        goal[9 + i] = base[i] * x + base[3 + i] * y + base[6 + i] * z
    for j in range(3):
        x, y, z = goal[j], goal[3 + j], goal[6 + j]
        for i in range(3):
            goal[3 * i + j] = base[i] * x + base[3 + i] * y + base[6 + i] * z


@part
def _tell(
    size: Size,
    row: int,
    arm: int,
    arms: Arms,
    costs: Costs,
    tolerances: Tolerances,
    error: Float64,
    dt: float,
    frame: _Frame,
    room: Room,
    solved: Solved,
) -> None:
    """Writes a frame's joints, errors and flags."""
    joints = arms.sizes[arm]
    near = math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2) / costs.weights[0]
    turned = math.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2) / costs.weights[1]
    flags = 0
    if near > tolerances.position or turned > tolerances.rotation:
        flags |= _OVER_TOLERANCE
    if near_singular(size, joints, tolerances.singular_below, costs.weights, room):
        flags |= _NEAR_SINGULAR
    for i in range(joints):
        q = frame.q[i]
        solved.q[row, arms.dims[arm, i]] = q
        if min(q - arms.lower[arm, i], arms.upper[arm, i] - q) <= _TOUCHING:
            flags |= _AT_LIMIT
        way = _WITHIN * arms.speed[arm, i] * dt
        if dt > 0 and abs(q - frame.before[i]) >= way * (1 - 1e-6):
            flags |= _AT_VELOCITY
    solved.position_error[row, arm] = near
    solved.rotation_error[row, arm] = turned
    solved.flags[row, arm] = flags
