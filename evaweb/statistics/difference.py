"""Comparison of the success rates of two independent arms: interval, posterior, exact test.

Formulae: Newcombe (1998), method 10, for the interval of a difference; Barnard (1945), pooled statistic, for the exact
unconditional test; the closed form for integer counts of the probability that one Beta variable exceeds another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from evaweb.statistics.base import LEVEL, Interval, check_counts
from evaweb.statistics.proportions import posterior, wilson

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_REMEMBERED = 4096  # tables in the cache of `barnard`
# The common rate at which extreme tables are likeliest is searched on a uniform grid of angles, on which binomial
# masses have the same width everywhere, and then refined around the highest peaks.
_RATES = 400
_PEAKS = 4
_ZOOMS = 4


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference of success rates, the first arm's minus the second's (-1 to 1), with its interval."""

    value: float
    interval: Interval

    @property
    def swapped(self) -> Difference:
        """The second arm's rate minus the first's."""
        ends = self.interval
        return Difference(-self.value, Interval(-ends.high, -ends.low, ends.level))


@dataclass(frozen=True, slots=True)
class ExactTest:
    """Statistic of an exact test, and its two-sided p-value.

    The p-value is the probability of a statistic at least as extreme if the arms are equal.
    """

    statistic: float
    p: float


def newcombe(x1: int, n1: int, x2: int, n2: int, level: float = LEVEL) -> Difference:
    """Return x1/n1 - x2/n2 with the interval built from both Wilson intervals; usable at 0/n and n/n too."""
    first, second = wilson(x1, n1, level), wilson(x2, n2, level)
    p1, p2 = x1 / n1, x2 / n2
    down = math.hypot(p1 - first.low, second.high - p2)
    up = math.hypot(first.high - p1, p2 - second.low)
    return Difference(p1 - p2, Interval(max(-1.0, p1 - p2 - down), min(1.0, p1 - p2 + up), level))


@lru_cache(maxsize=_REMEMBERED)
def barnard(x1: int, n1: int, x2: int, n2: int) -> ExactTest:
    """Return Barnard's exact test of x1/n1 against x2/n2, two-sided and pooled.

    The test is valid for a number of trials fixed beforehand. Repeated testing finds differences that do not exist: for
    that use the module `sequential`. If all or none succeeded in both arms, the statistic is 0 and p is 1.
    """
    check_counts(x1, n1)
    check_counts(x2, n2)
    if x1 + x2 in (0, n1 + n2):
        return ExactTest(0.0, 1.0)
    import numpy as np

    z = _statistics(n1, n2)
    # Equally extreme tables belong to the tail, also if they differ in the last bits.
    bound = abs(z[x1, x2]) * (1 - 1e-12)
    # The statistic falls along a row: the extreme tables are at its beginning and at its end.
    tails = (
        ((z >= bound).sum(axis=1), (z <= -bound).sum(axis=1))
        if bound
        else ([n2 + 1] * (n1 + 1), [0] * (n1 + 1))
    )
    extreme = np.array(tails)
    angles = np.linspace(0, math.pi / 2, _RATES + 2)[1:-1]
    p = _tail(extreme, n2, angles)
    peaks = [i for i in np.argsort(-p)[: _RATES // 8] if p[i] >= p[max(0, i - 1) : i + 2].max()][:_PEAKS]
    highest = float(p.max())
    for peak in peaks:
        middle, width = angles[peak], angles[1] - angles[0]
        for _ in range(_ZOOMS):
            near = np.clip(np.linspace(middle - width, middle + width, 21), 1e-9, math.pi / 2 - 1e-9)
            probabilities = _tail(extreme, n2, near)
            middle, width = near[probabilities.argmax()], width / 10
            highest = max(highest, float(probabilities.max()))
    return ExactTest(float(z[x1, x2]), min(1.0, highest))


def _statistics(n1: int, n2: int) -> NDArray[np.float64]:
    """Return the pooled statistic of every table: float64 [n1 + 1, n2 + 1]; 0 if all or none succeeded."""
    import numpy as np

    x1, x2 = np.arange(n1 + 1)[:, None], np.arange(n2 + 1)[None, :]
    pooled = (x1 + x2) / (n1 + n2)
    spread = np.sqrt(pooled * (1 - pooled) * (1 / n1 + 1 / n2))
    return np.divide(x1 / n1 - x2 / n2, spread, out=np.zeros(spread.shape), where=spread > 0)


def _tail(extreme: NDArray[np.int64], n2: int, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability of the extreme tables if both arms succeed at a rate of sin(angle)^2: float64 [angles].

    `extreme` [2, n1 + 1] counts the extreme tables at the beginning and at the end of each row.
    """
    import numpy as np
    from scipy.special import gammaln

    log_success, log_failure = np.log(np.sin(angles))[:, None], np.log(np.cos(angles))[:, None]

    def mass(n: int) -> NDArray[np.float64]:
        x = np.arange(n + 1)
        log_ways = gammaln(n + 1) - gammaln(x + 1) - gammaln(n - x + 1)
        return np.asarray(np.exp(log_ways + 2 * x * log_success + 2 * (n - x) * log_failure))

    first, second = mass(extreme.shape[1] - 1), mass(n2)
    nothing = np.zeros((len(angles), 1))
    below = np.hstack([nothing, np.cumsum(second, axis=1)])[:, extreme[0]]
    above = np.hstack([nothing, np.cumsum(second[:, ::-1], axis=1)])[:, extreme[1]]
    return np.asarray((first * (below + above)).sum(axis=1))


def probability_better(x1: int, n1: int, x2: int, n2: int) -> float:
    """Return the posterior probability that the first arm's success rate is higher, with uniform priors."""
    from scipy.special import betaln

    a, b = posterior(x2, n2), posterior(x1, n1)
    terms = [
        math.exp(betaln(a.a + i, b.b + a.b) - math.log(b.b + i) - betaln(1 + i, b.b) - betaln(a.a, a.b))
        for i in range(round(b.a))
    ]
    return min(1.0, math.fsum(terms))
