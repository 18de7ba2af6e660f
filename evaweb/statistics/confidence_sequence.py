"""How much two arms differ, as an interval that may be looked at after every pair.

A mean difference m is left out once a bet against it has reached 2/alpha: that the mean is above m, or that it is
below, by the gamblers of `sequential.score_evidence`, whose question is m = 0. By Ville's inequality the true mean is
ever left out with probability at most alpha, for any distribution of differences. Source: Waudby-Smith and Ramdas
(2023), section 4, with stakes that are fixed beforehand.
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

_ENOUGH = 1e-12  # of a difference: closer an end is not looked for


def confidence_sequence(differences: Sequence[float], alpha: float = ALPHA) -> Interval | None:
    """What the mean of `differences` (-1 to 1, the first arm's outcome less the second's, pair by pair) can be.

    It holds at `1 - alpha` after all pairs together, and only narrows with each; the order matters, and must be the
    true one. None where the pairs leave no mean that all of them could have. StatisticsError names what lies outside.
    """
    check_alpha(alpha)
    wrong = [d for d in differences if not abs(d) <= 1]
    if wrong:
        raise StatisticsError(f"a difference of {wrong[0]}; allowed: -1 to 1")
    low, high = _lower_bound(differences, alpha), -_lower_bound([-d for d in differences], alpha)
    return Interval(low, high, 1 - alpha) if low <= high else None


def _lower_bound(differences: Sequence[float], alpha: float) -> float:
    """The largest mean that a bet on more than it has refuted, -1 where there is none."""
    import numpy as np
    from scipy.optimize import brentq

    levels, which = np.unique(np.asarray(differences, dtype=float) + 1, return_inverse=True)
    if not len(levels) or levels[-1] == 0:
        return -1.0
    seen = np.cumsum(which[:, None] == np.arange(len(levels)), axis=0, dtype=float)
    wanted = math.log(2 / alpha)

    def beyond(mean: float) -> float:
        return _max_log_wealth(levels / (1 + mean), seen) - wanted

    # Each worth falls as the mean rises, and is at most 1 at a mean of 1.
    nearest = -1 + _ENOUGH
    return float(brentq(beyond, nearest, 1.0, xtol=_ENOUGH)) if beyond(nearest) > 0 else -1.0


def _max_log_wealth(shares: NDArray[np.float64], seen: NDArray[np.float64]) -> float:
    """The largest log worth that the gamblers together ever had: each level's outcome is `shares` [levels] of the
    mean, both counted from -1, and had been `seen` [pairs, levels] so often.
    """
    import numpy as np

    worths = seen @ np.log1p(np.array(BET_FRACTIONS) * (shares[:, None] - 1))
    most = float(worths.max())
    return most + math.log(float(np.exp(worths - most).sum(axis=1).max()) / len(BET_FRACTIONS))
