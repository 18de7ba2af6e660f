"""How a design whose outcome is a score ends, at scores that are assumed: power, and after how many pairs.

Assumed are means, a standard deviation, and that a score is a share of so many equal points: beta-binomial (Skellam,
1948), the widest family there is between points that are reached independently of each other and all or none. Pairs
are independent, and so are the two scores of a pair. Simulated with a fixed seed; each simulated evaluation is decided
by the design's own test. That of a fixed number is `permutation.sign_flips`, whose sums are counted exactly, here by
their characteristic function, for all evaluations at once; the other is `sequential.score_evidence`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from evaweb.statistics.base import StatisticsError, check_alpha, check_share
from evaweb.statistics.boundaries import MOST
from evaweb.statistics.courses import DesignPower
from evaweb.statistics.designs import ANYTIME, FIXED
from evaweb.statistics.sequential import BET_FRACTIONS

if TYPE_CHECKING:
    from numpy.typing import NDArray

RULES = (FIXED, ANYTIME)  # the designs that compare scores
LARGEST = 10  # points of a score: finer ones are as good as continuous
RUNS = 4000
_SEED = 20_261
_TIE = 1e-9  # relative, as where a design concludes


@dataclass(frozen=True, slots=True)
class Scores:
    """Mean scores of two checkpoints, the standard deviation of each, and of how many points a score is a share."""

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
        """The standard deviations that they have: as near to the assumed one as there are scores of such a mean."""
        first, second = (self._spread(mean) for mean in (self.first, self.second))
        return first, second

    def _spread(self, mean: float) -> float:
        widest = math.sqrt(mean * (1 - mean))
        return min(max(self.spread, widest / math.sqrt(self.points)), widest)

    def chances(self, mean: float) -> list[float]:
        """The probabilities of 0, 1 and so on up to all points."""
        k, widest, spread = self.points, mean * (1 - mean), self._spread(mean)
        if not widest:
            return [float(n == round(mean * k)) for n in range(k + 1)]
        # How much one point that is reached says of the others: 0 nothing, 1 all.
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
    """That of a design of so many pairs at most, among 4,000 simulated evaluations."""
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
    taken = np.minimum(stops, pairs)
    return DesignPower(
        rule, pairs, float((stops <= pairs).mean()), float(taken.mean()), int(np.median(taken))
    )


def score_pairs_needed(rule: str, scores: Scores, power: float, alpha: float) -> DesignPower | None:
    """The design of the fewest pairs that has this power; None where 250 pairs have it not."""
    check_share("power", power)
    low, high = 0, MOST
    if score_course(rule, high, scores, alpha).power < power:
        return None
    while high - low > 1:  # power grows with the pairs, but for what the steps of the test take
        middle = (low + high) // 2
        if score_course(rule, middle, scores, alpha).power >= power:
            high = middle
        else:
            low = middle
    return score_course(rule, high, scores, alpha)


@lru_cache(maxsize=8)
def _differences(scores: Scores) -> NDArray[Any]:
    """Differences of simulated scores in points [runs, most pairs]; the first columns are a smaller design's."""
    import numpy as np

    chance = np.random.default_rng(_SEED)
    found = np.zeros((RUNS, MOST), np.int8)
    for mean, sign in ((scores.first, 1), (scores.second, -1)):
        drawn = chance.random((RUNS, MOST), np.float32)
        for below in accumulate(scores.chances(mean)[:-1]):
            found += sign * (drawn >= below).astype(np.int8)
    return found


def _flipped(differences: NDArray[Any], points: int) -> NDArray[Any]:
    """Two-sided probability of each row [rows, pairs] by the permutation test, all signs counted."""
    import numpy as np

    sizes = np.abs(differences)
    total = sizes.sum(axis=1, dtype=np.int64)
    observed = np.abs(differences.sum(axis=1, dtype=np.int64))
    length = int(total.max()) + 1  # of the sums of what comes out below 0
    turns = np.exp(2j * np.pi * np.arange(length // 2 + 1) / length)
    spectrum = np.ones((len(sizes), len(turns)), complex)
    for size in range(1, points + 1):
        counts = (sizes == size).sum(axis=1)
        one = (1 + turns**-size) / 2  # of one difference, which comes out below 0 in half of all cases
        spectrum *= (one ** np.arange(int(counts.max()) + 1)[:, None])[counts]
    below = np.cumsum(np.fft.irfft(spectrum, length, axis=1), axis=1)
    least = ((total - observed) // 2)[:, None]
    p = 2 * np.take_along_axis(below, least, axis=1)[:, 0]
    return np.where(observed == 0, 1.0, np.minimum(1.0, p))


@lru_cache(maxsize=32)
def _stops(scores: Scores, alpha: float) -> NDArray[Any]:
    """After how many pairs each simulated evaluation is stopped by the e-process; one more than the most: never."""
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
