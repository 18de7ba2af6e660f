"""Inverse kinematics of a chunk: all frames of all arms, each frame from its predecessor."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from runtime.core.types import Float64, UInt8
from runtime.kinematics.chain_records import (
    POSED,
    Record,
    Records,
    chain_type,
)
from runtime.kinematics.kernels.compilation import device_function, kernel
from runtime.kinematics.kernels.forward_kinematics import compute_fk, fk_buffer_type
from runtime.kinematics.kernels.frame_solver import (
    Costs,
    frame_type,
    is_near_singular,
    solve_frame,
)
from runtime.kinematics.kernels.nullspace import add_nullspace_bias, update_jacobian
from runtime.kinematics.kernels.rotations import matrix_of

FINE, NOT_FINITE, NO_QUATERNION = 0, 1, 2
_OVER_TOLERANCE, _AT_LIMIT, _AT_VELOCITY, _NEAR_SINGULAR = 1, 2, 4, 8  # as in runtime.kinematics.base.IkFlag
_TOUCHING = 1e-9  # [rad, m] distance from a limit that counts as on it
_WITHIN = 1 - 1e-9  # share of the velocity limit used: rounding must not exceed it
_FAST = 1 - 1e-6  # share of it that counts as at the limit
_FOLLOWED = 1e-6  # weighted squared error (20 um) up to which a frame's motion is extrapolated
_KEPT = 0.9  # share of the motion in the next rest position: null-space motion decays within about ten frames
_GUIDED = 0.5  # share of the velocity limit used to approach a guide
_SHORTEST = 1e-12  # square of the shortest valid quaternion


def arm_type(moving: int, carrying: int, size: int) -> np.dtype[np.void]:
    """Return the type of an arm's record.

    `own` is the chain of the arm's own joints, padded to `moving` joints, and `carrier` the chain that carries it,
    padded to `carrying` joints. The arrays from `dims` on have one entry per driving number of `own`, padded with 0 to
    `size`; `joints` is the number of entries without the padding. `dims` are the indices of the driving numbers in the
    robot's vector, `lower` and `upper` their limits, `speed` their velocity limits, `home` their values at home. A
    limit repels a joint that is nearer to it than `below` (for `lower`) or `above` (for `upper`).
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
    """Return the type of the scratch memory of `solve_chunk`."""
    return np.dtype([("frame", frame_type(moving, size)), ("carried", fk_buffer_type(carrying))])


class Tolerances(NamedTuple):
    """Errors [m, rad] within which a frame is reached, and the singular value below which it is near singular."""

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
    """Compute joints, errors and flags for a chunk of poses; return FINE, NOT_FINITE or NO_QUATERNION.

    Args:
        arms: Records of the arms [A].
        costs: Weights of the solution.
        tolerances: Errors within which a frame is reached, and the bound for singularities.
        targets: Poses [T, A, 7].
        seed: Joints [1, D] from which the first frame is solved.
        dt: Time between frames [s]; 0 if there is no velocity limit.
        anchor: Joints [D] before row `anchor_row`.
        anchor_row: First row for which the velocity limit applies; -1: no anchor, the limit applies from row 1 on.
        guide: Joints [T, D] that the rows should approach; [0, D] if there is no guide.
        scratches: Scratch memory, one element.
        q: Receives the joints [T, D].
        position_error: Receives the position errors [T, A] in m.
        rotation_error: Receives the rotation errors [T, A] in rad.
        flags: Receives the flags [T, A].
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
    """Set the start of the first frame to the seed, clipped to the limits."""
    for i in range(len(frame.q)):
        value = seed[0, arm.dims[i]] if i < arm.joints else 0.0
        frame.q[i] = min(max(value, arm.lower[i]), arm.upper[i])
        frame.before[i] = frame.q[i]


@device_function
def _set_bounds(arm: Record, dt: float, frame: Record) -> None:
    """Set the bounds of the joints for one frame.

    The bounds are the joint limits. If `dt` is above 0, they are also limited to what each joint can reach within `dt`
    [s] from frame.before, the joints before this frame, which are first clipped to the joint limits.
    """
    for i in range(len(frame.q)):
        frame.lower[i], frame.upper[i] = arm.lower[i], arm.upper[i]
        if dt > 0:
            reach = _WITHIN * arm.speed[i] * dt
            frame.before[i] = min(max(frame.before[i], arm.lower[i]), arm.upper[i])
            frame.lower[i] = max(arm.lower[i], frame.before[i] - reach)
            frame.upper[i] = min(arm.upper[i], frame.before[i] + reach)


@device_function
def _set_start(going: bool, frame: Record) -> None:
    """Set the start of a frame's search and its rest position.

    If `going`, i.e. the previous frame reached its target, the motion is extrapolated: fully for the start, and mostly
    for the rest position. On a smooth path one iteration then suffices, and at a singularity, where solution branches
    meet, the motion continues straight.
    """
    for i in range(len(frame.q)):
        begin = min(max(frame.q[i], frame.lower[i]), frame.upper[i])
        motion = frame.motion[i] if going else 0.0
        frame.begin[i] = begin
        frame.centre[i] = begin + _KEPT * motion
        frame.tried[0, i] = min(max(begin + motion, frame.lower[i]), frame.upper[i])


@device_function
def _follow_guide(arm: Record, guide: Float64, row: int, dt: float, frame: Record) -> None:
    """Set the start and the rest position of a frame to joints that follow the guide's row `row`.

    They are as close to the guide as possible, but within the limits, and within the distance from the previous frame
    that the joints may travel in `dt` [s].
    """
    for i in range(arm.joints):
        reach = _GUIDED * arm.speed[i] * dt
        guided = min(max(guide[row, arm.dims[i]], frame.before[i] - reach), frame.before[i] + reach)
        frame.centre[i] = min(max(guided, frame.lower[i]), frame.upper[i])
        frame.tried[0, i] = frame.centre[i]


@device_function
def _set_goal(targets: Float64, row: int, index: int, carried: Float64, goal: Float64) -> None:
    """Write to `goal` [12] the target pose relative to the base of the arm's own chain.

    `carried` has the frames of the carrier, i.e. of the chain that carries the arm, in sequence. The last of them is
    the base of the arm's own chain.
    """
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
    """Return position [m] and rotation error [rad] of the solution."""
    away, astray = 0.0, 0.0
    for k in range(3):
        away += frame.error[k] ** 2
        astray += frame.error[3 + k] ** 2
    return math.sqrt(away) / costs.position, math.sqrt(astray) / costs.rotation


@device_function
def _flags(arm: Record, dt: float, costs: Costs, tolerances: Tolerances, frame: Record) -> int:
    """Return the flags of the solution: limits, velocity limits, singularity."""
    flags = 0
    if is_near_singular(arm.joints, tolerances.singular_below, costs, frame):
        flags |= _NEAR_SINGULAR
    for i in range(arm.joints):
        if min(frame.q[i] - arm.lower[i], arm.upper[i] - frame.q[i]) <= _TOUCHING:
            flags |= _AT_LIMIT
        if dt > 0 and abs(frame.q[i] - frame.before[i]) >= _FAST * arm.speed[i] * dt:
            flags |= _AT_VELOCITY
    return flags
