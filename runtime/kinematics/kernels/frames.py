"""The joints that bring one chain's tip to one pose: damped least squares in a hard box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from runtime.kinematics.kernels.boxes import box_qp_type, solve_box_qp
from runtime.kinematics.kernels.chains import compute_fk, compute_jacobian, fk_buffer_type
from runtime.kinematics.kernels.compiling import device_function
from runtime.kinematics.kernels.rotations import relative_rotation, rotation_vector
from runtime.kinematics.tables import Record

_LARGEST_STEP = 0.5  # rad (m) of one iteration: linearisation is worth nothing farther out
_CLOSE_ENOUGH = 1e-9  # weighted squared error: below 1 um and 5 urad
_STALLED = 1e-4  # a relative fall of the cost below which another iteration is not worth its time
_FIRST_DAMPING = 1e-4  # part of the diagonal that is added once a step has failed
_GREATEST_DAMPING = 1e6  # with which any system is positive definite
_LEAST_DAMPING = 1e-8  # below it there is none


class Costs(NamedTuple):
    """Costs of a solve: a metre and a radian beside the pose, a radian (m) away from what a frame rests on.

    `home_rate` [1/s] is the rate at which what the pose leaves open goes home.
    """

    position: float
    rotation: float
    rest: float
    home_rate: float
    max_iterations: int


def frame_type(moving: int, size: int) -> np.dtype[np.void]:
    """One frame while it is solved, for a chain of so many moving joints that `size` numbers drive."""
    vector = (size,)
    return np.dtype(
        [
            ("reach", fk_buffer_type(moving)),
            ("box", box_qp_type(size)),
            ("goal", np.float64, (12,)),
            ("q", np.float64, vector),
            ("tried", np.float64, (1, size)),
            ("lower", np.float64, vector),  # the box that q may not leave
            ("upper", np.float64, vector),
            ("begin", np.float64, vector),  # where it begins: the frame before, within the box
            ("centre", np.float64, vector),  # what it rests on
            ("before", np.float64, vector),  # what its velocity counts from
            ("motion", np.float64, vector),  # of the frame before
            ("jacobian", np.float64, (6, size)),  # weighted
            ("error", np.float64, (6,)),  # weighted: position, then rotation vector from goal to tip
            ("attempt", np.float64, (6,)),  # that of `tried`
            ("normal", np.float64, (6, 6)),
            ("free", np.float64, (2, size)),  # steps that are to move no pose: towards home, and on as before
            ("stiffness", np.float64, vector),  # of what pulls towards home
            ("moved", np.float64, (2, 6)),  # what they would move
        ]
    )


@device_function
def solve_frame(chain: Record, costs: Costs, frame: Record) -> float:
    """Into frame.q the joints in [lower, upper] whose tip comes closest to `goal`, found from frame.tried on.

    Levenberg-Marquardt, undamped until a step fails, then damped by the gain ratio (Nielsen 1999, IMM-REP-1999-05);
    every step is a small quadratic problem in the box. Ends when the error is negligible or its cost has stopped
    falling, which bounds what an unreachable target takes. Gives the weighted squared error of q; `error` and
    `jacobian` are its.
    """
    n = len(frame.q)
    q, tried, box = frame.q, frame.tried, frame.box
    rest = costs.rest * costs.rest
    cost, missed, predicted, damping, growth = np.inf, np.inf, 0.0, 0.0, 2.0
    for iteration in range(costs.max_iterations + 1):
        compute_fk(chain, tried, 0, frame.reach)
        off = _evaluate(costs, frame)
        strayed = 0.0
        for i in range(n):
            strayed += (tried[0, i] - frame.centre[i]) ** 2
        fall = cost - (off + rest * strayed)
        if fall > 0 or iteration == 0:
            stalled = iteration > 0 and fall <= _STALLED * cost
            cost, missed = off + rest * strayed, off
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
            _set_quadratic(rest, frame)
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
    """Into frame.attempt the weighted error of the tip; its square.

    The derivative of its rotation vector is taken as the geometric one, which leaves the gradient exact.
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
    """The system, the gradient of half the cost at q, and how far a step may go."""
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
    """By how much the step would lower the cost if that were the undamped quadratic."""
    total = 0.0
    for i in range(len(box.step)):
        across = 2 * box.gradient[i] + box.system[i, i] * box.step[i]
        for j in range(i):
            across += 2 * box.system[i, j] * box.step[j]
        total -= box.step[i] * across
    return total


@device_function
def is_near_singular(joints: int, below: float, costs: Costs, frame: Record) -> bool:
    """True if the smallest singular value of the unweighted Jacobian of so many joints lies below `below`.

    It does where J J^T - below^2 (J^T J with fewer than six joints) has a pivot that is not positive.
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
    """J J^T below its diagonal; J^T J, filled up with an identity, where there are fewer than six joints."""
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
