"""The joints that bring one chain's tip to one pose: damped least squares in a hard box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from runtime.kinematics.kernels.boxes import step_in_box
from runtime.kinematics.kernels.chains import frames_of, jacobian_of
from runtime.kinematics.kernels.compiling import part
from runtime.kinematics.kernels.rotations import rotation_between
from runtime.kinematics.kernels.sizes import Size
from runtime.kinematics.tables import ChainTables
from runtime.types import Float64, UInt8

_LARGEST_STEP = 0.5  # rad (m) of one iteration: linearisation is worth nothing farther out
_CLOSE_ENOUGH = 1e-9  # weighted squared error: below 1 um and 5 urad
_STALLED = 1e-4  # a relative fall of the cost below which another iteration is not worth its time
_FIRST_DAMPING = 1e-4  # part of the diagonal that is added once a step has failed
_LEAST_DAMPING = 1e-8  # below it there is none


class Costs(NamedTuple):
    """What a solve weighs: [position per m, rotation per rad], and a radian away from the frame before."""

    weights: Float64
    rest: float
    max_iterations: int


class Room(NamedTuple):
    """Arrays that a solve overwrites, made once per chunk; of the errors one is for the joints tried."""

    turns: Float64  # [3, M]
    frames: Float64  # [M + 1, 12]
    jacobian: Float64  # [6, n]
    errors: tuple[Float64, Float64]  # [6]
    spare: Float64  # [13]
    system: Float64  # [n, n]
    damped: Float64  # [n, n]
    factors: Float64  # [n, n]
    gradient: Float64  # [n]
    slope: Float64
    move: Float64
    step: Float64
    low: Float64
    high: Float64
    held: UInt8
    trial: Float64  # [1, n]
    normal: Float64  # [6, 6]


@part
def room_for(moving: Size, size: Size) -> Room:
    """Room for chains of so many moving joints, driven by so many numbers."""
    n = len(size)
    return Room(
        np.empty((3, len(moving))),
        np.empty((len(moving) + 1, 12)),
        np.empty((6, n)),
        (np.empty(6), np.empty(6)),
        np.empty(13),
        np.empty((n, n)),
        np.empty((n, n)),
        np.empty((n, n)),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n, dtype=np.uint8),
        np.empty((1, n)),
        np.empty((6, 6)),
    )


@part
def solve_frame(
    moving: Size,
    size: Size,
    chain: int,
    tables: ChainTables,
    costs: Costs,
    goal: Float64,
    centre: Float64,
    lower: Float64,
    upper: Float64,
    q: Float64,
    room: Room,
) -> Float64:
    """Into `q` [n] the joints in [lower, upper] whose tip comes closest to `goal` [12], found from q on.

    Levenberg-Marquardt, undamped until a step fails, then damped by the gain ratio (Nielsen 1999, IMM-REP-1999-05);
    every step is a small quadratic problem in the box. `centre` [n] is what the rest weight holds to. Ends when the
    error is negligible or its cost has stopped falling, which bounds what an unreachable target takes. Gives the
    weighted error [6] of q, whose weighted Jacobian is then room.jacobian.
    """
    n = len(size)
    error, other = room.errors
    rest = costs.rest * costs.rest
    cost, predicted, damping, growth = np.inf, 0.0, 0.0, 2.0
    for i in range(n):
        room.trial[0, i] = q[i]
    for iteration in range(costs.max_iterations + 1):
        frames_of(moving, chain, tables, room.trial, 0, room.turns, room.frames)
        missed = _error_of(moving, costs, goal, room, other)
        strayed = 0.0
        for i in range(n):
            strayed += (room.trial[0, i] - centre[i]) ** 2
        fall = cost - (missed + rest * strayed)
        if fall > 0 or iteration == 0:
            error, other = other, error
            for i in range(n):
                q[i] = room.trial[0, i]
            jacobian_of(moving, chain, tables, room.frames, costs.weights, room.jacobian)
            stalled = iteration > 0 and fall <= _STALLED * cost
            cost = missed + rest * strayed
            if stalled or (missed <= _CLOSE_ENOUGH and (iteration > 0 or strayed == 0.0)):
                break
            if damping > 0:
                damping *= max(1 / 3, 1 - (2 * fall / predicted - 1) ** 3)
                damping = damping if damping > _LEAST_DAMPING else 0.0
            growth = 2.0
            _quadratic_of(size, rest, error, centre, q, room)
            for i in range(n):
                room.low[i] = max(lower[i] - q[i], -_LARGEST_STEP)
                room.high[i] = min(upper[i] - q[i], _LARGEST_STEP)
        else:
            damping = max(damping * growth, _FIRST_DAMPING)
            growth *= 2.0
        if not _stepped(size, damping, room):
            damping = max(damping * growth, _FIRST_DAMPING)
            growth *= 2.0
            _stepped(size, damping, room)
        predicted = _promised(size, room)
        if predicted <= 1e-3 * _STALLED * cost:
            break
        for i in range(n):
            room.trial[0, i] = min(max(q[i] + room.step[i], lower[i]), upper[i])
    return error


@part
def _error_of(moving: Size, costs: Costs, goal: Float64, room: Room, error: Float64) -> float:
    """Into `error` [6] that of the tip, weighted: position, then the rotation vector from goal to tip; its square.

    The derivative of that vector is taken as the geometric one, which leaves the gradient exact.
    """
    m = len(moving)
    rotation_between(room.frames[m], goal, error[3:], room.spare)
    total = 0.0
    for k in range(3):
        error[k] = costs.weights[0] * (room.frames[m, 9 + k] - goal[9 + k])
        error[3 + k] *= costs.weights[1]
        total += error[k] * error[k] + error[3 + k] * error[3 + k]
    return total


@part
def _quadratic_of(size: Size, rest: float, error: Float64, centre: Float64, q: Float64, room: Room) -> None:
    """The system and the gradient of half the cost at q."""
    for i in range(len(size)):
        room.gradient[i] = rest * (q[i] - centre[i])
        for k in range(6):
            room.gradient[i] += room.jacobian[k, i] * error[k]
        for j in range(i + 1):
            total = rest if i == j else 0.0
            for k in range(6):
                total += room.jacobian[k, i] * room.jacobian[k, j]
            room.system[i, j] = total


@part
def _stepped(size: Size, damping: float, room: Room) -> bool:
    """The step of the damped system; False where even so it is not positive definite."""
    for i in range(len(size)):
        for j in range(i):
            room.damped[i, j] = room.system[i, j]
        room.damped[i, i] = room.system[i, i] + damping * (1.0 + room.system[i, i])
    return step_in_box(
        size,
        room.damped,
        room.gradient,
        room.low,
        room.high,
        room.step,
        room.factors,
        room.slope,
        room.move,
        room.held,
    )


@part
def _promised(size: Size, room: Room) -> float:
    """By how much the step would lower the cost if that were the quadratic."""
    total = 0.0
    for i in range(len(size)):
        across = 2 * room.gradient[i]
        for j in range(len(size)):
            across += (room.system[i, j] if j <= i else room.system[j, i]) * room.step[j]
        total -= room.step[i] * across
    return total


@part
def near_singular(size: Size, joints: int, below: float, weights: Float64, room: Room) -> bool:
    """Whether the smallest singular value of the unweighted Jacobian lies below `below`.

    It does where J J^T - below^2 (J^T J with fewer than six joints) has a pivot that is not positive.
    """
    normal = room.normal
    for i in range(6):
        for j in range(i + 1):
            normal[i, j] = _product(size, joints, weights, room.jacobian, i, j)
        normal[i, i] -= below * below
    for j in range(6):
        if not normal[j, j] > 0:
            return True
        for i in range(j + 1, 6):
            share = normal[i, j] / normal[j, j]
            for k in range(j + 1, i + 1):
                normal[i, k] -= share * normal[k, j]
    return False


@part
def _product(size: Size, joints: int, weights: Float64, jacobian: Float64, i: int, j: int) -> float:
    """Entry i, j of J J^T, or of J^T J filled up with an identity where there are fewer than six joints."""
    total = 0.0
    if joints >= 6:
        for k in range(len(size)):
            total += jacobian[i, k] * jacobian[j, k]
        return total / float(weights[i // 3] * weights[j // 3])
    if i >= joints:
        return 2.0 if i == j else 0.0
    for k in range(6):
        total += jacobian[k, i] * jacobian[k, j] / (weights[k // 3] * weights[k // 3])
    return total
