"""The step that minimises a small quadratic in a box."""

from __future__ import annotations

from runtime.kinematics.kernels.compiling import part
from runtime.kinematics.kernels.sizes import Size
from runtime.types import Float64, UInt8

_DEFINITE = 1e-13  # of its diagonal must be left of a row


@part
def step_in_box(
    size: Size,
    system: Float64,
    gradient: Float64,
    lower: Float64,
    upper: Float64,
    step: Float64,
    factors: Float64,
    slope: Float64,
    move: Float64,
    held: UInt8,
) -> bool:
    """Into `step` [n] the d in [lower, upper], which holds 0, that minimises gradient . d + d . system . d / 2.

    Primal active set for a strictly convex problem (Nocedal and Wright, Numerical Optimization, 16.5): walk to the
    first wall, hold that joint, solve again for the others; let go of a wall that the slope leaves. Each part lowers
    the value, so a step that is cut short still descends. `system` [n, n] is read below its diagonal; `factors`
    [n, n], `slope`, `move` and `held` [n] are overwritten. False where the system is not positive definite.
    """
    n = len(size)
    for i in range(n):
        step[i] = 0.0
        slope[i] = gradient[i]
        held[i] = (lower[i] >= 0 and gradient[i] > 0) or (upper[i] <= 0 and gradient[i] < 0)
    for _ in range(4 * n):
        if not _solved(size, system, slope, held, factors, move):
            return False
        first, share = -1, 1.0
        for i in range(n):
            room = (upper[i] if move[i] > 0 else lower[i]) - step[i]
            if not held[i] and abs(move[i]) > abs(room) and (first < 0 or abs(room) < share * abs(move[i])):
                first, share = i, abs(room) / abs(move[i])
        for i in range(n):
            if not held[i]:
                step[i] += share * move[i]
        if first >= 0:
            step[first] = upper[first] if move[first] > 0 else lower[first]
            held[first] = 1
        elif not _any(size, held):
            return True
        _slope_of(size, system, gradient, step, slope)
        if first < 0 and not _let_go(size, lower, upper, step, slope, held):
            return True
    return True


@part
def _any(size: Size, held: UInt8) -> bool:
    found = 0
    for i in range(len(size)):
        found += held[i]
    return found > 0


@part
def _slope_of(size: Size, system: Float64, gradient: Float64, step: Float64, slope: Float64) -> None:
    for i in range(len(size)):
        total = gradient[i]
        for j in range(len(size)):
            total += (system[i, j] if j <= i else system[j, i]) * step[j]
        slope[i] = total


@part
def _let_go(size: Size, lower: Float64, upper: Float64, step: Float64, slope: Float64, held: UInt8) -> bool:
    """Frees the held joint that the slope pulls hardest from its wall; whether there was one."""
    hardest, pull = -1, 0.0
    for i in range(len(size)):
        inwards = slope[i] if step[i] >= upper[i] else -slope[i]
        if held[i] and lower[i] < upper[i] and inwards > pull:
            hardest, pull = i, inwards
    if hardest >= 0:
        held[hardest] = 0
    return hardest >= 0


@part
def _solved(
    size: Size, system: Float64, slope: Float64, held: UInt8, factors: Float64, move: Float64
) -> bool:
    """Into `move` what takes the slope to zero in all joints that are not held, by Cholesky's L D L^T.

    Column by column; below the diagonal stands what is left of the system, on it 1 / D, above it L transposed.
    A held joint is a row of the identity: it moves by nothing.
    """
    n = len(size)
    for i in range(n):
        move[i] = 0.0 if held[i] else -slope[i]
        for j in range(i + 1):
            factors[i, j] = 0.0 if held[i] or held[j] else system[i, j]
        if held[i]:
            factors[i, i] = 1.0
    definite = True
    for j in range(n):
        definite = definite and factors[j, j] > _DEFINITE * system[j, j]
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
