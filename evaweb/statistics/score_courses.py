"""Operating characteristics of designs that compare scores, at assumed scores: power, and number of pairs.

The user assumes mean scores, a standard deviation, and the number of equal points of which a score is a share. The
points of a score are assumed to have a beta-binomial distribution (Skellam 1948). It is the widest family between two
extremes: points that are reached independently, and points that are all reached or none. Pairs are independent, and so
are the two scores of a pair.

Evaluations are simulated with a fixed seed, and each is decided by the design's own test. For a fixed number of pairs
this is the test of `permutation.sign_flip_test`, which counts the sums exactly; here they are computed by their
characteristic function for all evaluations at once. Otherwise it is the test of `sequential.score_evidence`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from evaweb.statistics.base import StatisticsError, check_alpha, check_share
from evaweb.statistics.boundaries import MOST
from evaweb.statistics.design_power import DesignPower
from evaweb.statistics.designs import ANYTIME, FIXED
from evaweb.statistics.sequential import BET_FRACTIONS

if TYPE_CHECKING:
    from numpy.typing import NDArray

RULES = (FIXED, ANYTIME)  # designs that can compare scores
LARGEST = 10  # greatest number of points of a score; finer scores are nearly continuous
RUNS = 4000
_SEED = 20_261
_TIE = 1e-9  # relative; the same as in `designs`


@dataclass(frozen=True, slots=True)
class Scores:
    """Assumed mean scores of two checkpoints, their standard deviation, and the number of points of a score."""

    first: float
    second: float
    spread: float
    points: int

    def __post_init__(self) -> None:
        check_share("mean score", self.first)
        check_share("mean score", self.second)
        if not 0 <= self.spread <= 0.5:
            raise StatisticsError(
                f"standard deviation = {self.spread:g}; allowed: 0 to 0.5, that of scores of 0 and 1"
            )
        if not 1 <= self.points <= LARGEST:
            raise StatisticsError(f"{self.points} points; allowed: 1 to {LARGEST}")

    def spreads(self) -> tuple[float, float]:
        """Return the standard deviation of each checkpoint's scores.

        It is the assumed one, or the nearest that is possible for the checkpoint's mean and the number of points.
        """
        first, second = (self._spread(mean) for mean in (self.first, self.second))
        return first, second

    def _spread(self, mean: float) -> float:
        widest = math.sqrt(mean * (1 - mean))
        return min(max(self.spread, widest / math.sqrt(self.points)), widest)

    def chances(self, mean: float) -> list[float]:
        """Return the probabilities of 0, 1, ... up to all points for a mean score."""
        k, widest, spread = self.points, mean * (1 - mean), self._spread(mean)
        if not widest:
            return [float(n == round(mean * k)) for n in range(k + 1)]
        # Correlation between points: 0 independent, 1 identical.
        share = (spread**2 / widest * k - 1) / (k - 1) if k > 1 else 0.0
        if share > 1 - 1e-9:
            return [1 - mean, *[0.0] * (k - 1), mean]
        if share < 1e-9:
            return [math.comb(k, n) * mean**n * (1 - mean) ** (k - n) for n in range(k + 1)]
        a, b = mean * (1 / share - 1), (1 - mean) * (1 / share - 1)
        whole = _log_beta(a, b)
        return [math.comb(k, n) * math.exp(_log_beta(a + n, b + k - n) - whole) for n in range(k + 1)]


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


@lru_cache(maxsize=512)
def score_course(rule: str, pairs: int, scores: Scores, alpha: float) -> DesignPower:
    """Return the power of a design of at most `pairs` pairs, from 4,000 simulated evaluations."""
    import numpy as np

    check_alpha(alpha)
    if rule not in RULES:
        raise StatisticsError(f"design = {rule!r} of scores; allowed: {', '.join(RULES)}")
    if not 1 <= pairs <= MOST:
        raise StatisticsError(f"{pairs} pairs; allowed: 1 to {MOST}")
    if rule == FIXED:
        power = float((_flipped(_differences(scores)[:, :pairs], scores.points) <= alpha * (1 + _TIE)).mean())
        return DesignPower(rule, pairs, power, float(pairs), pairs)
    stops = _stops(scores, alpha)
    needed = np.minimum(stops, pairs)
    return DesignPower(
        rule, pairs, float((stops <= pairs).mean()), float(needed.mean()), int(np.median(needed))
    )


def score_pairs_needed(rule: str, scores: Scores, power: float, alpha: float) -> DesignPower | None:
    """Return the design with the fewest pairs that reaches this power, or None if 250 pairs do not."""
    check_share("power", power)
    low, high = 0, MOST
    if score_course(rule, high, scores, alpha).power < power:
        return None
    while high - low > 1:  # power grows with the pairs, apart from the discreteness of the test
        middle = (low + high) // 2
        if score_course(rule, middle, scores, alpha).power >= power:
            high = middle
        else:
            low = middle
    return score_course(rule, high, scores, alpha)


@lru_cache(maxsize=8)
def _differences(scores: Scores) -> NDArray[Any]:
    """Return simulated score differences in points: int8 [runs, MOST], one row per evaluation.

    A design with fewer pairs than MOST uses the first columns.
    """
    import numpy as np

    chance = np.random.default_rng(_SEED)
    differences = np.zeros((RUNS, MOST), np.int8)
    for mean, sign in ((scores.first, 1), (scores.second, -1)):
        drawn = chance.random((RUNS, MOST), np.float32)
        for below in accumulate(scores.chances(mean)[:-1]):
            differences += sign * (drawn >= below).astype(np.int8)
    return differences


def _flipped(differences: NDArray[Any], points: int) -> NDArray[Any]:
    """Return the two-sided p-value of the sign-flip test for each row of `differences` [rows, pairs].

    The differences are integers from -points to `points`. The test is exact: all combinations of signs are counted.
    """
    import numpy as np

    sizes = np.abs(differences)
    total = sizes.sum(axis=1, dtype=np.int64)
    observed = np.abs(differences.sum(axis=1, dtype=np.int64))
    length = int(total.max()) + 1  # number of possible sums of the negative differences
    turns = np.exp(2j * np.pi * np.arange(length // 2 + 1) / length)
    spectrum = np.ones((len(sizes), len(turns)), complex)
    for size in range(1, points + 1):
        counts = (sizes == size).sum(axis=1)
        factor = (1 + turns**-size) / 2  # of one difference, which is negative in half of all cases
        spectrum *= (factor ** np.arange(int(counts.max()) + 1)[:, None])[counts]
    below = np.cumsum(np.fft.irfft(spectrum, length, axis=1), axis=1)
    least = ((total - observed) // 2)[:, None]
    p = 2 * np.take_along_axis(below, least, axis=1)[:, 0]
    return np.where(observed == 0, 1.0, np.minimum(1.0, p))


@lru_cache(maxsize=32)
def _stops(scores: Scores, alpha: float) -> NDArray[Any]:
    """Return, for each simulated evaluation, the number of pairs after which the e-process stops it.

    The number is MOST + 1 for an evaluation that is never stopped.
    """
    import numpy as np

    differences = _differences(scores).astype(np.intp) + scores.points
    shares = np.arange(-scores.points, scores.points + 1) / scores.points
    stops = np.full(RUNS, MOST + 1)
    for ahead in (shares, -shares):
        worth = np.zeros(differences.shape)
        for stake in BET_FRACTIONS:
            worth += np.exp(np.cumsum(np.log1p(stake * ahead)[differences], axis=1)) / len(BET_FRACTIONS)
        reached = worth >= 2 / alpha
        stops = np.minimum(stops, np.where(reached.any(axis=1), reached.argmax(axis=1) + 1, MOST + 1))
    return stops
