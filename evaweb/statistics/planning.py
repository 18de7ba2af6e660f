"""Number of trials needed for a difference, and the difference that a number of trials can detect.

Formulae: the normal approximation for two proportions, checked by the exact power of Barnard's test, whose
probabilities are computed for all tables at once.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

from evaweb.statistics.base import StatisticsError, check_alpha, check_share, z_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ALPHA = 0.05
POWER = 0.8
MOST = 250  # trials per arm; the tables of more would take too long for a page
_RATES = 400  # common success rates at which a table's probability is computed; the largest counts


def trials_needed(p1: float, p2: float, power: float = POWER, alpha: float = ALPHA) -> int:
    """Return the trials per arm to find with probability `power` that the rates `p1` and `p2` differ (two-sided)."""
    _check(p1, p2, alpha)
    check_share("power", power)
    middle = (p1 + p2) / 2
    z_alpha, z_power = z_of(1 - alpha), z_of(2 * power - 1) if power > 0.5 else -z_of(1 - 2 * power)
    spread = z_alpha * math.sqrt(2 * middle * (1 - middle)) + z_power * math.sqrt(
        p1 * (1 - p1) + p2 * (1 - p2)
    )
    return max(1, math.ceil(spread**2 / (p1 - p2) ** 2 - 1e-9))


def approximate_power(n: int, p1: float, p2: float, alpha: float = ALPHA) -> float:
    """Return the power of `n` trials per arm to detect that rates `p1` and `p2` differ, by the normal approximation."""
    _check(p1, p2, alpha)
    from scipy.special import ndtr

    middle = (p1 + p2) / 2
    above = abs(p1 - p2) * math.sqrt(n) - z_of(1 - alpha) * math.sqrt(2 * middle * (1 - middle))
    spread = math.sqrt(p1 * (1 - p1) + p2 * (1 - p2))
    return float(ndtr(above / spread)) if spread > 0 else float(above > 0)


def exact_power(n: int, p1: float, p2: float, alpha: float = ALPHA) -> float:
    """Return the power by Barnard's exact test, for at most 250 trials per arm."""
    check_share("p1", p1)
    check_share("p2", p2)
    check_alpha(alpha)
    if not 1 <= n <= MOST:
        raise StatisticsError(f"n = {n} trials of each arm; allowed: 1 to {MOST}")
    import numpy as np

    first, second = _masses(n, np.array([p1, p2]))
    return float(np.outer(first, second)[_barnard_tables(n) <= alpha].sum())


def detectable(n: int, p: float, power: float = POWER, alpha: float = ALPHA) -> float | None:
    """Return the smallest gain over success rate `p` that `n` trials per arm detect with probability `power`.

    None if even a rate of 1 is not detected.
    """
    check_share("p", p)
    if p >= 1 or approximate_power(n, p, 1.0, alpha) < power:
        return None
    low, high = p, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        if middle > p and approximate_power(n, p, middle, alpha) >= power:
            high = middle
        else:
            low = middle
    return high - p


@lru_cache(maxsize=MOST)
def _barnard_tables(n: int) -> NDArray[np.float64]:
    """Return p of Barnard's two-sided pooled test for every table of two arms of `n` trials: float64 [n+1, n+1].

    Cached for every `n`; all of them together use 42 MB.
    """
    import numpy as np

    x = np.arange(n + 1)
    p1, p2 = x[:, None] / n, x[None, :] / n
    pooled = (p1 + p2) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.abs(p1 - p2) / np.sqrt(2 * pooled * (1 - pooled) / n)
    z = np.where(np.isfinite(z), z, 0.0).round(10)  # rounded, so that equally extreme tables stay together
    levels, level = np.unique(-z.ravel(), return_inverse=True)
    worst = np.zeros(len(levels))
    # Exchanging success and failure leaves every table as extreme: rates above 0.5 add nothing.
    for mass in _masses(n, np.linspace(0, 1, _RATES + 2)[1 : _RATES // 2 + 1]):
        level_mass = np.bincount(level.ravel(), weights=np.outer(mass, mass).ravel(), minlength=len(levels))
        np.maximum(worst, np.cumsum(level_mass), out=worst)
    return np.minimum(worst, 1.0)[level].reshape(n + 1, n + 1)


def _masses(n: int, rates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the binomial distributions of `n` trials: float64 [rates, n+1]; avoids the slow import of scipy.stats."""
    import numpy as np
    from scipy.special import gammaln, xlog1py, xlogy

    x = np.arange(n + 1)
    log_ways = gammaln(n + 1) - gammaln(x + 1) - gammaln(n - x + 1)
    return np.asarray(np.exp(log_ways + xlogy(x, rates[:, None]) + xlog1py(n - x, -rates[:, None])))


def _check(p1: float, p2: float, alpha: float) -> None:
    check_share("p1", p1)
    check_share("p2", p2)
    check_alpha(alpha)
    if p1 == p2:
        raise StatisticsError(f"p1 = p2 = {p1}: no number of trials shows a difference that is not there")
