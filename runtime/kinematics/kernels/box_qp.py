"""Minimisation of a small quadratic function in a box."""

from __future__ import annotations

import numpy as np

from runtime.kinematics.chain_records import Record
from runtime.kinematics.kernels.compilation import device_function

_DEFINITE = 1e-13  # share of the diagonal that a pivot must exceed


def box_qp_type(size: int) -> np.dtype[np.void]:
    """Return the type of a quadratic problem in `size` variables.

    It contains the problem's numbers, the bounds around 0, the solution, and scratch memory.
    """
    vector, square = (size,), (size, size)
    return np.dtype(
        [
            ("system", np.float64, square),  # below its diagonal
            ("gradient", np.float64, vector),
            ("low", np.float64, vector),
            ("high", np.float64, vector),
            ("step", np.float64, vector),
            ("factors", np.float64, square),
            ("slope", np.float64, vector),
            ("move", np.float64, vector),
            ("held", np.int64, vector),
        ]
    )


@device_function
def solve_box_qp(box: Record, damping: float) -> bool:
    """Minimise gradient . d + d . damped system . d / 2 for d in [low, high], which contains 0; write it to box.step.

    Primal active set for a strictly convex problem (Nocedal and Wright, Numerical Optimization, 16.5): move to the
    first bound, fix that variable, solve again for the others; release a bound if the slope points inwards. Each move
    lowers the value, so an incomplete solution is still a descent step. Returns False if the system is not positive
    definite.
    """
    gradient, low, high, step, move, held = box.gradient, box.low, box.high, box.step, box.move, box.held
    n = len(gradient)
    for i in range(n):
        step[i] = 0.0
        box.slope[i] = gradient[i]
        held[i] = (low[i] >= 0 and gradient[i] > 0) or (high[i] <= 0 and gradient[i] < 0)
    for _ in range(4 * n):
        if not _solve(box, damping):
            return False
        first, share = -1, 1.0
        for i in range(n):
            room = abs((high[i] if move[i] > 0 else low[i]) - step[i])
            if not held[i] and room < share * abs(move[i]):
                first, share = i, room / abs(move[i])
        for i in range(n):
            step[i] += share * move[i]  # the move of a fixed variable is 0
        if first >= 0:
            step[first] = high[first] if move[first] > 0 else low[first]
            held[first] = 1
            _set_slope(box, damping)
        elif not _release_bound(box, damping):
            break
    return True


@device_function
def _set_slope(box: Record, damping: float) -> None:
    n = len(box.step)
    for i in range(n):
        total = box.gradient[i] + damping * (1 + box.system[i, i]) * box.step[i]
        for j in range(n):
            total += (box.system[i, j] if j <= i else box.system[j, i]) * box.step[j]
        box.slope[i] = total


@device_function
def _release_bound(box: Record, damping: float) -> bool:
    """Release one variable that is fixed at its bound; return True if there was one to release.

    The released variable is the one with the largest slope towards the inside of the box. A variable with equal bounds
    is never released. `damping` is the damping of the step, which is part of the slopes.
    """
    n = len(box.step)
    holding = 0
    for i in range(n):
        holding += box.held[i]
    if holding == 0:
        return False
    _set_slope(box, damping)
    hardest, pull = -1, 0.0
    for i in range(n):
        inwards = box.slope[i] if box.step[i] >= box.high[i] else -box.slope[i]
        if box.held[i] and box.low[i] < box.high[i] and inwards > pull:
            hardest, pull = i, inwards
    if hardest >= 0:
        box.held[hardest] = 0
    return hardest >= 0


@device_function
def _solve(box: Record, damping: float) -> bool:
    """Write to box.move the step that makes the slope of all free variables zero, by Cholesky's L D L^T.

    The factors are computed column by column: below the diagonal is the rest of the system, on it 1 / D, above it L
    transposed. A fixed variable is a row of the identity, so that its move is zero. Returns False if the system is not
    positive definite.
    """
    factors, move, held = box.factors, box.move, box.held
    n = len(move)
    for i in range(n):
        move[i] = 0.0 if held[i] else -box.slope[i]
        for j in range(i):
            factors[i, j] = 0.0 if held[i] or held[j] else box.system[i, j]
        factors[i, i] = 1.0 if held[i] else box.system[i, i] + damping * (1 + box.system[i, i])
    definite = True
    for j in range(n):
        definite = definite and factors[j, j] > _DEFINITE * box.system[j, j]
        inverse = 1 / factors[j, j]
        factors[j, j] = inverse
        for i in range(j + 1, n):
            share = factors[i, j] * inverse
            factors[j, i] = share
            move[i] -= share * move[j]
            for k in range(j + 1, i + 1):
                factors[i, k] -= share * factors[k, j]
    for i in range(n - 1, -1, -1):
        total = move[i] * factors[i, i]
        for j in range(i + 1, n):
            total -= factors[i, j] * move[j]
        move[i] = total
    return definite
