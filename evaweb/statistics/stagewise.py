"""Median-unbiased estimate of the difference of two arms for a design that may stop early.

A design that stops when the difference is large overestimates it. Outcomes are therefore ordered by the stage at which
they occur (Armitage 1957; Tsiatis, Rosner and Mehta 1984): an early stop for the first arm ranks highest, an early stop
for the second lowest; at the end, and among tables of one look, the larger difference ranks higher. The estimate is the
difference of rates under which the observed outcome is the median of that order; at the interval's ends the probability
of an outcome at least as far out is (1 - level) / 2. Of all pairs of rates with a given difference, the most likely
pair is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from evaweb.statistics.base import LEVEL, Interval, StatisticsError
from evaweb.statistics.boundaries import Boundary, _add_trials
from evaweb.statistics.difference import Difference

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

_EDGE = 1e-9  # distance of rates and differences from the ends of their range
_HALVED = 60


@lru_cache(maxsize=256)
def stagewise(found: Boundary, first: int, n: int, second: int, m: int, level: float = LEVEL) -> Difference:
    """Return the first arm's rate minus the second's for a design without margin that ended with these successes.

    Args:
        found: Boundary of the design.
        first: Successes of the first arm, in `n` trials.
        n: Trials of the first arm.
        second: Successes of the second arm, in `m` trials.
        m: Trials of the second arm.
        level: Confidence level of the interval.

    Raises:
        StatisticsError: If the design did not end there.
    """
    number = next((i for i, at in enumerate(found.looks) if (at.first, at.second) == (n, m)), None)
    if found.margin is not None or number is None:
        raise StatisticsError(f"no look of this design is after {n} and {m} trials")
    if found.winner(number, first, second) is None and number < len(found.looks) - 1:
        raise StatisticsError(f"the design goes on after {first}/{n} and {second}/{m}")
    order = _ordered(found, number, first, second)
    tail = (1 - level) / 2

    def at(target: float, more: Callable[[float, float], float]) -> float:
        """Return the difference of rates at which `more` equals `target`, by bisection.

        `more` is a function of the probabilities of outcomes with a higher and with the same rank.
        """
        low, high = -1.0 + _EDGE, 1.0 - _EDGE
        for _ in range(_HALVED):
            middle = (low + high) / 2
            if more(*order.probabilities(*_likeliest(middle, first, n, second, m))) < target:
                low = middle
            else:
                high = middle
        return (low + high) / 2

    value = at(0.5, lambda more, same: more + same / 2)
    low = at(tail, lambda more, same: more + same)
    high = at(1 - tail, lambda more, same: more)
    return Difference(value, Interval(low, high, level))


@dataclass(frozen=True, slots=True)
class _Order:
    """Tables that rank higher than the observed one (lower if `mirrored`), and tables of the same rank.

    Each row holds successes and failures of both arms, and the log probability at rates of 0.5: float64 [tables, 5].
    """

    beyond: NDArray[np.float64]
    same: NDArray[np.float64]
    mirrored: bool

    def probabilities(self, p_first: float, p_second: float) -> tuple[float, float]:
        """Return the probabilities of outcomes with a higher and with the same rank at these rates."""
        beyond, same = (_mass(tables, p_first, p_second) for tables in (self.beyond, self.same))
        return (1 - beyond - same if self.mirrored else beyond), same


def _ordered(boundary: Boundary, last: int, first: int, second: int) -> _Order:
    import numpy as np

    winner = boundary.winner(last, first, second)
    mirrored = winner == "second"
    alive, before = np.ones((1, 1)), (0, 0)
    beyond: list[NDArray[np.float64]] = []
    for number, (at, region) in enumerate(zip(boundary.looks, boundary.regions, strict=True)):
        alive = _add_trials(alive, at.first - before[0], at.second - before[1], (0.5, 0.5))
        before = (at.first, at.second)
        a, b = np.indices(alive.shape)
        lead = a * at.second - b * at.first
        stops = region & ((lead < 0) if mirrored else (lead > 0))
        if number < last:
            beyond.append(_tables(np.where(stops, alive, 0.0)))
            alive = np.where(region, 0.0, alive)
            continue
        observed = first * at.second - second * at.first
        among = stops if winner else ~region
        ahead = among & ((lead < observed) if mirrored else (lead > observed))
        if (
            winner is None
        ):  # at the last look, every stop for the first arm ranks above the tables that do not stop
            ahead |= stops
        beyond.append(_tables(np.where(ahead, alive, 0.0)))
        return _Order(
            np.concatenate(beyond), _tables(np.where(among & (lead == observed), alive, 0.0)), mirrored
        )
    raise StatisticsError("a design needs at least one look")


def _tables(mass: NDArray[np.float64]) -> NDArray[np.float64]:
    import numpy as np

    a, b = np.nonzero(mass)
    n, m = mass.shape[0] - 1, mass.shape[1] - 1
    return np.column_stack([a, n - a, b, m - b, np.log(mass[a, b])]).astype(float)


def _mass(tables: NDArray[np.float64], p_first: float, p_second: float) -> float:
    import numpy as np

    rates = np.log([2 * p_first, 2 * (1 - p_first), 2 * p_second, 2 * (1 - p_second)])
    return float(np.exp(tables[:, :4] @ rates + tables[:, 4]).sum())


def _likeliest(difference: float, first: int, n: int, second: int, m: int) -> tuple[float, float]:
    """Return the rates with this difference that maximise the likelihood (root of its slope)."""
    low, high = max(0.0, -difference) + _EDGE / 4, min(1.0, 1.0 - difference) - _EDGE / 4
    for _ in range(_HALVED):
        q = (low + high) / 2
        p = q + difference
        slope = first / p - (n - first) / (1 - p) + second / q - (m - second) / (1 - q)
        if slope > 0:
            low = q
        else:
            high = q
    q = (low + high) / 2
    return _inside(q + difference), _inside(q)


def _inside(rate: float) -> float:
    return min(max(rate, _EDGE / 8), math.nextafter(1.0, 0.0) - _EDGE / 8)
