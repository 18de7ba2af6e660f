"""Redundancy resolution: with more than six joints, null-space motion towards home and away from limits."""

from __future__ import annotations

import numpy as np

from runtime.kinematics.chain_records import POSED, Record
from runtime.kinematics.kernels.compilation import device_function
from runtime.kinematics.kernels.forward_kinematics import compute_fk, compute_jacobian
from runtime.kinematics.kernels.frame_solver import Costs, set_normal_matrix

_FARTHEST = 0.6  # [rad, m] from home beyond which the pull is constant, so that limits outweigh it
_REPELLED = 4.0  # [rad, m] push of a limit at half of the required distance
_TOUCHING = 0.01  # [rad, m] distance below which the push is constant
_UNHURRIED = 0.2  # share of the joint velocities that is used at most
_SINGULAR = 0.002  # approximate smallest singular value at which the pull is halved
_DEFINITE = 1e-9  # least pivot


@device_function
def update_jacobian(chain: Record, costs: Costs, frame: Record) -> None:
    """Write to frame.jacobian the Jacobian at frame.q, before a frame is solved."""
    for i in range(len(frame.q)):
        frame.tried[0, i] = frame.q[i]
    compute_fk(chain, frame.tried, 0, frame.reach)
    compute_jacobian(chain, frame.reach, costs.position, costs.rotation, frame.jacobian)


@device_function
def add_nullspace_bias(arm: Record, costs: Costs, dt: float, going: bool, frame: Record) -> None:
    """Shift the solver's first guess and rest position for one row by a step in the null space of frame.jacobian.

    The step descends a potential that grows with the distance from home and near joint limits (gradient projection,
    Liegeois 1977). It replaces the null-space part of the motion that is extrapolated from the previous row: it depends
    on the posture only, so that a closed path of the tip is closed in joint space too. It does not move the tip, and
    fades out at singularities, where the extra freedom chooses between solution branches.
    """
    free = frame.free
    for i in range(len(frame.q)):
        free[0, i] = costs.home_rate * dt * _potential_gradient(arm, i, frame) if i < arm.joints else 0.0
        free[1, i] = frame.centre[i] - frame.begin[i] if going else 0.0
    freedom = _project_nullspace(arm.joints, costs, frame)
    square, bend, fastest = 0.0, 0.0, 1.0
    for i in range(arm.joints):
        square += free[0, i] * free[0, i]
        bend += frame.stiffness[i] * free[0, i] * free[0, i]
        fastest = max(fastest, abs(free[0, i]) / (_UNHURRIED * arm.speed[i] * dt))
    part_of = 1 / max(fastest, 1 + costs.home_rate * dt * bend / square) if square > 0 else 0.0
    for i in range(len(frame.q)):
        step = freedom * (part_of * free[0, i] - free[1, i])
        frame.centre[i] += step
        frame.tried[0, i] = min(max(frame.tried[0, i] + step, frame.lower[i]), frame.upper[i])


@device_function
def _potential_gradient(arm: Record, joint: int, frame: Record) -> float:
    """Return the negative gradient of the potential [rad, m], which points to home and away from near limits.

    Write to frame.stiffness the second derivative of the potential with respect to the joint.
    """
    value = frame.begin[joint]
    away = arm.home[joint] - value
    pull, stiffness = min(max(away, -_FARTHEST), _FARTHEST), 1.0 if abs(away) < _FARTHEST else 0.0
    below, above = value - arm.lower[joint], arm.upper[joint] - value
    if below < arm.below[joint]:
        room = max(below, _TOUCHING)
        pull += _REPELLED * (arm.below[joint] / room - 1)
        stiffness += _REPELLED * arm.below[joint] / (room * room)
    if above < arm.above[joint]:
        room = max(above, _TOUCHING)
        pull -= _REPELLED * (arm.above[joint] / room - 1)
        stiffness += _REPELLED * arm.above[joint] / (room * room)
    frame.stiffness[joint] = stiffness
    return float(pull)


@device_function
def _project_nullspace(joints: int, costs: Costs, frame: Record) -> float:
    """Project both rows of frame.free to the null space; return the distance from a singularity, from 0 to 1.

    At a singularity the result is 0, and the rows are not projected. The projection is free - J^T (J J^T)^-1 J free. It
    is computed by the factorisation L D L^T of the matrix J J^T in `normal`, in place: D is stored on the diagonal, L
    transposed above it, and the product L D remains below it.
    """
    normal, jacobian, free, moved = frame.normal, frame.jacobian, frame.free, frame.moved
    set_normal_matrix(joints, costs, frame)
    for j in range(POSED):
        weight = 1 / (costs.position if j < 3 else costs.rotation)
        for side in range(2):
            total = 0.0
            for k in range(len(frame.q)):
                total += weight * jacobian[j, k] * free[side, k]
            moved[side, j] = total
    smallest = np.inf
    for j in range(POSED):
        pivot = normal[j, j]
        if not pivot > _DEFINITE:
            return 0.0
        smallest = min(smallest, pivot)
        for i in range(j + 1, POSED):
            share = normal[i, j] / pivot
            normal[j, i] = share
            for side in range(2):
                moved[side, i] -= share * moved[side, j]
            for k in range(j + 1, i + 1):
                normal[i, k] -= share * normal[k, j]
    for side in range(2):
        for i in range(POSED - 1, -1, -1):
            total = moved[side, i] / normal[i, i]
            for j in range(i + 1, POSED):
                total -= normal[i, j] * moved[side, j]
            moved[side, i] = total
            weight = 1 / (costs.position if i < 3 else costs.rotation)
            for k in range(len(frame.q)):
                free[side, k] -= weight * jacobian[i, k] * total
    return smallest / (smallest + _SINGULAR * _SINGULAR)
