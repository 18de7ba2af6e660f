"""A whole chunk: all frames of all arms, each frame from the one before."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from runtime.core.types import Float64, UInt8
from runtime.kinematics.kernels.chains import compute_fk, fk_buffer_type
from runtime.kinematics.kernels.compiling import device_function, kernel
from runtime.kinematics.kernels.frames import Costs, frame_type, is_near_singular, solve_frame
from runtime.kinematics.kernels.postures import add_nullspace_bias, update_jacobian
from runtime.kinematics.kernels.rotations import matrix_of
from runtime.kinematics.tables import POSED, Record, Records, chain_type

FINE, NOT_FINITE, NO_QUATERNION = 0, 1, 2
_OVER_TOLERANCE, _AT_LIMIT, _AT_VELOCITY, _NEAR_SINGULAR = 1, 2, 4, 8  # runtime.kinematics.base.IkFlag
_TOUCHING = 1e-9  # rad (m) from a limit: on it
_WITHIN = 1 - 1e-9  # of the way that a velocity allows is used, so that rounding never exceeds it
_FAST = 1 - 1e-6  # of that way: as fast as it may
_FOLLOWED = 1e-6  # weighted squared error (20 um) up to which a frame's motion is worth going on with
_KEPT = 0.9  # of a motion is what a frame rests on: what poses leave open dies away within some ten frames
_GUIDED = 0.5  # of the way that a velocity allows is used to come closer to a guide
_SHORTEST = 1e-12  # square of a quaternion's length


def arm_type(moving: int, carrying: int, size: int) -> np.dtype[np.void]:
    """An arm whose own chain, of so many moving joints, `size` numbers drive, at the end of the chain that carries it.

    Of these numbers the first `joints` are its own, at the places `dims` of the robot's vector, within `lower` and
    `upper`, no faster than `speed`; the others stand still at 0. Their limits push where they are nearer than `below`
    and `above`.
    """
    return np.dtype(
        [
            ("own", chain_type(moving)),
            ("carrier", chain_type(carrying)),  # driven by the robot's vector
            ("joints", np.int64),
            ("dims", np.int64, (size,)),
            ("lower", np.float64, (size,)),
            ("upper", np.float64, (size,)),
            ("speed", np.float64, (size,)),
            ("home", np.float64, (size,)),
            ("below", np.float64, (size,)),
            ("above", np.float64, (size,)),
        ]
    )


def scratch_type(moving: int, carrying: int, size: int) -> np.dtype[np.void]:
    """Type of the memory that solving a chunk overwrites."""
    return np.dtype([("frame", frame_type(moving, size)), ("carried", fk_buffer_type(carrying))])


class Tolerances(NamedTuple):
    """When a frame counts as reached, and when as near singular."""

    position: float
    rotation: float
    singular_below: float


@kernel
def solve_chunk(
    arms: Records,
    costs: Costs,
    tolerances: Tolerances,
    targets: Float64,
    seed: Float64,
    dt: float,
    anchor: Float64,
    anchor_row: int,
    guide: Float64,
    scratches: Records,
    q: Float64,
    position_error: Float64,
    rotation_error: Float64,
    flags: UInt8,
) -> int:
    """Joints q [T, D], errors and flags [T, A] for targets [T, A, 7] from seed [1, D].

    dt [s] 0: no velocity limit; anchor [D]; anchor_row -1: no anchor; guide [T, D] is what rows are to come close
    to, [0, D]: nothing; one scratch is needed. FINE, or what is wrong with the numbers given.
    """
    wrong = _wrong(targets, seed, anchor)
    if wrong != FINE:
        return wrong
    for row in range(len(targets)):
        for dim in range(seed.shape[1]):
            q[row, dim] = seed[0, dim]
    carried, frame = scratches[0].carried, scratches[0].frame
    for index in range(len(arms)):
        arm = arms[index]
        compute_fk(arm.carrier, seed, 0, carried)
        _set_first_seed(arm, seed, frame)
        free = dt > 0 and arm.joints > POSED
        if free:
            update_jacobian(arm.own, costs, frame)
        bound, going = False, False
        for row in range(len(targets)):
            if row == anchor_row:
                bound, going = True, False
                for i in range(arm.joints):
                    frame.before[i] = anchor[arm.dims[i]]
            _set_bounds(arm, dt if bound else 0.0, frame)
            _set_start(going, frame)
            if len(guide) > 0:
                _follow_guide(arm, guide, row, dt, frame)
            elif free:
                add_nullspace_bias(arm, costs, dt, going, frame)
            _set_goal(targets, row, index, carried.frames, frame.goal)
            missed = solve_frame(arm.own, costs, frame)
            away, astray = _errors(costs, frame)
            position_error[row, index], rotation_error[row, index] = away, astray
            flags[row, index] = _flags(arm, dt if bound else 0.0, costs, tolerances, frame)
            if away > tolerances.position or astray > tolerances.rotation:
                flags[row, index] |= _OVER_TOLERANCE
            for i in range(arm.joints):
                q[row, arm.dims[i]] = frame.q[i]
            for i in range(len(frame.q)):
                frame.motion[i] = frame.q[i] - frame.begin[i]
                frame.before[i] = frame.q[i]
            bound, going = row >= anchor_row, missed <= _FOLLOWED
    return FINE


@device_function
def _wrong(targets: Float64, seed: Float64, anchor: Float64) -> int:
    for dim in range(len(anchor)):
        if not math.isfinite(seed[0, dim]) or not math.isfinite(anchor[dim]):
            return NOT_FINITE
    for row in range(len(targets)):
        for index in range(targets.shape[1]):
            square = 0.0
            for k in range(7):
                if not math.isfinite(targets[row, index, k]):
                    return NOT_FINITE
                square += targets[row, index, k] ** 2 if k > 2 else 0.0
            if square < _SHORTEST:
                return NO_QUATERNION
    return FINE


@device_function
def _set_first_seed(arm: Record, seed: Float64, frame: Record) -> None:
    """The joints that the first frame begins with: the seed, within limits."""
    for i in range(len(frame.q)):
        there = seed[0, arm.dims[i]] if i < arm.joints else 0.0
        frame.q[i] = min(max(there, arm.lower[i]), arm.upper[i])
        frame.before[i] = frame.q[i]


@device_function
def _set_bounds(arm: Record, dt: float, frame: Record) -> None:
    """The box of a frame: its limits, and, where dt is given, what velocities leave of them around `before`."""
    for i in range(len(frame.q)):
        frame.lower[i], frame.upper[i] = arm.lower[i], arm.upper[i]
        if dt > 0:
            way = _WITHIN * arm.speed[i] * dt
            frame.before[i] = min(max(frame.before[i], arm.lower[i]), arm.upper[i])
            frame.lower[i] = max(arm.lower[i], frame.before[i] - way)
            frame.upper[i] = min(arm.upper[i], frame.before[i] + way)


@device_function
def _set_start(going: bool, frame: Record) -> None:
    """Set the start of a frame's search, and the joints it rests on.

    Where the one before met its target, that is where its motion leads, and most of that motion: on a smooth path
    one step is then enough, and where branches meet (a singularity) it goes straight on.
    """
    for i in range(len(frame.q)):
        begin = min(max(frame.q[i], frame.lower[i]), frame.upper[i])
        motion = frame.motion[i] if going else 0.0
        frame.begin[i] = begin
        frame.centre[i] = begin + _KEPT * motion
        frame.tried[0, i] = min(max(begin + motion, frame.lower[i]), frame.upper[i])


@device_function
def _follow_guide(arm: Record, guide: Float64, row: int, dt: float, frame: Record) -> None:
    """Has the frame begin at, and rest on, what is closest to the guide's row and not too far from the frame before."""
    for i in range(arm.joints):
        way = _GUIDED * arm.speed[i] * dt
        there = min(max(guide[row, arm.dims[i]], frame.before[i] - way), frame.before[i] + way)
        frame.centre[i] = min(max(there, frame.lower[i]), frame.upper[i])
        frame.tried[0, i] = frame.centre[i]


@device_function
def _set_goal(targets: Float64, row: int, index: int, carried: Float64, goal: Float64) -> None:
    """Into `goal` [12] the target as it is seen from where the arm's own chain begins, the last of `carried`."""
    base = len(carried) - 1
    matrix = matrix_of(
        targets[row, index, 3], targets[row, index, 4], targets[row, index, 5], targets[row, index, 6]
    )
    x = targets[row, index, 0] - carried[base, 9]
    y = targets[row, index, 1] - carried[base, 10]
    z = targets[row, index, 2] - carried[base, 11]
    for i in range(3):
        a, b, c = carried[base, i], carried[base, 3 + i], carried[base, 6 + i]
        for j in range(3):
            goal[3 * i + j] = a * matrix[j] + b * matrix[3 + j] + c * matrix[6 + j]
        goal[9 + i] = a * x + b * y + c * z


@device_function
def _errors(costs: Costs, frame: Record) -> tuple[float, float]:
    """Errors of the joints found, in m and rad."""
    away, astray = 0.0, 0.0
    for k in range(3):
        away += frame.error[k] ** 2
        astray += frame.error[3 + k] ** 2
    return math.sqrt(away) / costs.position, math.sqrt(astray) / costs.rotation


@device_function
def _flags(arm: Record, dt: float, costs: Costs, tolerances: Tolerances, frame: Record) -> int:
    """Flags of the joints found: limits that they touch, and freedom of the tip there."""
    flags = 0
    if is_near_singular(arm.joints, tolerances.singular_below, costs, frame):
        flags |= _NEAR_SINGULAR
    for i in range(arm.joints):
        if min(frame.q[i] - arm.lower[i], arm.upper[i] - frame.q[i]) <= _TOUCHING:
            flags |= _AT_LIMIT
        if dt > 0 and abs(frame.q[i] - frame.before[i]) >= _FAST * arm.speed[i] * dt:
            flags |= _AT_VELOCITY
    return flags
