"""Inverse kinematics of one chain for one pose: damped least squares in a hard box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from runtime.kinematics.chain_records import Record
from runtime.kinematics.kernels.box_qp import box_qp_type, solve_box_qp
from runtime.kinematics.kernels.compilation import device_function
from runtime.kinematics.kernels.forward_kinematics import compute_fk, compute_jacobian, fk_buffer_type
from runtime.kinematics.kernels.rotations import relative_rotation, rotation_vector

_LARGEST_STEP = 0.5  # [rad, m] per iteration: the linearisation is invalid farther out
_CLOSE_ENOUGH = 1e-9  # weighted squared error: below 1 um and 5 urad
_STALLED = 1e-4  # relative decrease of the cost below which another iteration is not worthwhile
_FIRST_DAMPING = 1e-4  # share of the diagonal that is added after a failed step
_GREATEST_DAMPING = 1e6  # any system is positive definite with it
_LEAST_DAMPING = 1e-8  # smaller values become 0


class Costs(NamedTuple):
    """Weights in the cost of a solution, and the largest number of iterations.

    The weights are those of position error [per m], rotation error [per rad] and distance from the rest position [per
    rad or m]. `home_rate` [1/s] is the rate at which redundant joints return to home.
    """

    position: float
    rotation: float
    rest: float
    home_rate: float
    max_iterations: int


def frame_type(moving: int, size: int) -> np.dtype[np.void]:
    """Return the type of the data of one frame during its solution.

    It is for a chain of `moving` joints that `size` numbers drive.
    """
    vector = (size,)
    return np.dtype(
        [
            ("reach", fk_buffer_type(moving)),
            ("box", box_qp_type(size)),
            ("goal", np.float64, (12,)),
            ("q", np.float64, vector),
            ("tried", np.float64, (1, size)),
            ("lower", np.float64, vector),  # bounds of q
            ("upper", np.float64, vector),
            ("begin", np.float64, vector),  # start: the previous frame, within the bounds
            ("centre", np.float64, vector),  # rest position
            ("before", np.float64, vector),  # reference of the velocity limit
            ("motion", np.float64, vector),  # of the previous frame
            ("jacobian", np.float64, (6, size)),  # weighted
            ("error", np.float64, (6,)),  # weighted: position, then rotation vector from goal to tip
            ("attempt", np.float64, (6,)),  # error of `tried`
            ("normal", np.float64, (6, 6)),
            ("free", np.float64, (2, size)),  # null-space steps: towards home, and the continued motion
            ("stiffness", np.float64, vector),  # second derivative of the potential towards home
            ("moved", np.float64, (2, 6)),  # tip motion of the steps in `free`
        ]
    )


@device_function
def solve_frame(chain: Record, costs: Costs, frame: Record) -> float:
    """Solve IK for one frame: write to frame.q the joints in [lower, upper] with the tip closest to `goal`.

    Starts from frame.tried. Levenberg-Marquardt, undamped until a step fails, then damped by the gain ratio (Nielsen
    1999, IMM-REP-1999-05); every step is a small quadratic problem in the box. Ends when the error is negligible or
    the cost no longer falls, which bounds the time for an unreachable target.

    Returns:
        Weighted squared error at frame.q; `error` and `jacobian` belong to it.
    """
    n = len(frame.q)
    q, tried, box = frame.q, frame.tried, frame.box
    rest_weight = costs.rest * costs.rest
    cost, missed, predicted, damping, growth = np.inf, np.inf, 0.0, 0.0, 2.0
    for iteration in range(costs.max_iterations + 1):
        compute_fk(chain, tried, 0, frame.reach)
        off = _evaluate(costs, frame)
        strayed = 0.0
        for i in range(n):
            strayed += (tried[0, i] - frame.centre[i]) ** 2
        fall = cost - (off + rest_weight * strayed)
        if fall > 0 or iteration == 0:
            stalled = iteration > 0 and fall <= _STALLED * cost
            cost, missed = off + rest_weight * strayed, off
            for i in range(n):
                q[i] = tried[0, i]
            for k in range(6):
                frame.error[k] = frame.attempt[k]
            compute_jacobian(chain, frame.reach, costs.position, costs.rotation, frame.jacobian)
            if stalled or (missed <= _CLOSE_ENOUGH and (iteration > 0 or strayed == 0.0)):
                break
            if damping > 0:
                damping *= max(1 / 3, 1 - (2 * fall / predicted - 1) ** 3)
                damping = damping if damping > _LEAST_DAMPING else 0.0
            growth = 2.0
            _set_quadratic(rest_weight, frame)
        else:
            damping = max(damping * growth, _FIRST_DAMPING)
            growth *= 2.0
        while not solve_box_qp(box, damping) and damping < _GREATEST_DAMPING:
            damping = max(damping * growth, _FIRST_DAMPING)
            growth *= 2.0
        predicted = _predicted_decrease(box)
        if predicted <= 1e-3 * _STALLED * cost:
            break
        for i in range(n):
            tried[0, i] = min(max(q[i] + box.step[i], frame.lower[i]), frame.upper[i])
    return missed


@device_function
def _evaluate(costs: Costs, frame: Record) -> float:
    """Write to frame.attempt the weighted error of the tip; return the sum of its squares.

    The geometric Jacobian is used as derivative of the rotation vector; the gradient remains exact.
    """
    frames, goal = frame.reach.frames, frame.goal
    last = len(frames) - 1
    turned = rotation_vector(relative_rotation(frames, last, goal))
    total = 0.0
    for k in range(3):
        away, astray = costs.position * (frames[last, 9 + k] - goal[9 + k]), costs.rotation * turned[k]
        frame.attempt[k], frame.attempt[3 + k] = away, astray
        total += away * away + astray * astray
    return total


@device_function
def _set_quadratic(rest: float, frame: Record) -> None:
    """Set the quadratic problem for the next step, which starts from frame.q.

    The problem consists of the gradient of half the cost, the matrix of its linear system, and the box. The box is the
    range of steps that stay within the bounds. `rest` is the weight of the distance from the rest position.
    """
    box, jacobian = frame.box, frame.jacobian
    for i in range(len(frame.q)):
        slope = rest * (frame.q[i] - frame.centre[i])
        for k in range(6):
            slope += jacobian[k, i] * frame.error[k]
        box.gradient[i] = slope
        for j in range(i + 1):
            total = rest if i == j else 0.0
            for k in range(6):
                total += jacobian[k, i] * jacobian[k, j]
            box.system[i, j] = total
        box.low[i] = max(frame.lower[i] - frame.q[i], -_LARGEST_STEP)
        box.high[i] = min(frame.upper[i] - frame.q[i], _LARGEST_STEP)


@device_function
def _predicted_decrease(box: Record) -> float:
    """Return the decrease of the cost that the quadratic problem without damping predicts for the step."""
    total = 0.0
    for i in range(len(box.step)):
        across = 2 * box.gradient[i] + box.system[i, i] * box.step[i]
        for j in range(i):
            across += 2 * box.system[i, j] * box.step[j]
        total -= box.step[i] * across
    return total


@device_function
def is_near_singular(joints: int, below: float, costs: Costs, frame: Record) -> bool:
    """Return True if the smallest singular value of the unweighted Jacobian of `joints` joints is less than `below`.

    This is the case if J J^T - below^2 I (J^T J with fewer than six joints) has a pivot that is not positive.
    """
    normal = frame.normal
    set_normal_matrix(joints, costs, frame)
    for i in range(6):
        normal[i, i] -= below * below
    for j in range(6):
        if not normal[j, j] > 0:
            return True
        inverse = 1 / normal[j, j]
        for i in range(j + 1, 6):
            share = normal[i, j] * inverse
            for k in range(j + 1, i + 1):
                normal[i, k] -= share * normal[k, j]
    return False


@device_function
def set_normal_matrix(joints: int, costs: Costs, frame: Record) -> None:
    """Set the lower triangle of frame.normal to J J^T; with fewer than six joints, to J^T J, padded."""
    normal, jacobian = frame.normal, frame.jacobian
    metre, radian = 1 / (costs.position * costs.position), 1 / (costs.rotation * costs.rotation)
    mixed = 1 / (costs.position * costs.rotation)
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            if joints >= 6:
                for k in range(jacobian.shape[1]):
                    total += jacobian[i, k] * jacobian[j, k]
                total *= metre if i < 3 else (mixed if j < 3 else radian)
            elif i < joints:
                for k in range(3):
                    total += metre * jacobian[k, i] * jacobian[k, j]
                    total += radian * jacobian[3 + k, i] * jacobian[3 + k, j]
            elif i == j:
                total = np.inf
            normal[i, j] = total
