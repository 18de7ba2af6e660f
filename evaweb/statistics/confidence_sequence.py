"""Confidence sequence of the difference of two arms: an interval that is valid after every pair.

Two bets are placed against each mean difference m: that the mean is above m, and that it is below m. As soon as one of
them has reached 2/alpha, m is excluded. The bets are those of `sequential.score_evidence`, which tests m = 0. By
Ville's inequality the true mean is ever excluded with probability at most alpha, for any distribution of differences.
Source: Waudby-Smith and Ramdas (2023), section 4, with stakes fixed beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from evaweb.statistics.base import Interval, StatisticsError, check_alpha
from evaweb.statistics.sequential import ALPHA, BET_FRACTIONS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_ENOUGH = 1e-12  # tolerance of an interval end, as a difference


def confidence_sequence(differences: Sequence[float], alpha: float = ALPHA) -> Interval | None:
    """Return the interval of the mean of `differences`, or None if the pairs exclude every mean.

    It is valid at `1 - alpha` after all pairs simultaneously and can only narrow. The pairs must be in their true
    order.

    Args:
        differences: First arm's outcome minus the second's, pair by pair (-1 to 1).
        alpha: Probability of ever excluding the true mean.

    Raises:
        StatisticsError: If a difference lies outside -1 to 1.
    """
    check_alpha(alpha)
    wrong = [d for d in differences if not abs(d) <= 1]
    if wrong:
        raise StatisticsError(f"a difference of {wrong[0]}; allowed: -1 to 1")
    low, high = _lower_bound(differences, alpha), -_lower_bound([-d for d in differences], alpha)
    return Interval(low, high, 1 - alpha) if low <= high else None


def _lower_bound(differences: Sequence[float], alpha: float) -> float:
    """Return the largest mean that the bet on a higher mean has refuted, -1 if it has refuted none."""
    import numpy as np
    from scipy.optimize import brentq

    levels, which = np.unique(np.asarray(differences, dtype=float) + 1, return_inverse=True)
    if not len(levels) or levels[-1] == 0:
        return -1.0
    counts = np.cumsum(which[:, None] == np.arange(len(levels)), axis=0, dtype=float)
    threshold = math.log(2 / alpha)

    def beyond(mean: float) -> float:
        return _max_log_wealth(levels / (1 + mean), counts) - threshold

    # The log wealth falls as the mean rises, and is at most 0 at a mean of 1: there is at most one root.
    nearest = -1 + _ENOUGH
    return float(brentq(beyond, nearest, 1.0, xtol=_ENOUGH)) if beyond(nearest) > 0 else -1.0


def _max_log_wealth(shares: NDArray[np.float64], counts: NDArray[np.float64]) -> float:
    """Return the largest log wealth that the gamblers together had after any pair.

    `shares` [levels] has (1 + level) / (1 + tested mean) for each distinct difference `level`; `counts` [pairs, levels]
    is the number of pairs with each level so far.
    """
    import numpy as np

    worths = counts @ np.log1p(np.array(BET_FRACTIONS) * (shares[:, None] - 1))
    most = float(worths.max())
    return most + math.log(float(np.exp(worths - most).sum(axis=1).max()) / len(BET_FRACTIONS))
