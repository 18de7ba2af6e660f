"""Success rate: `successes` out of `n`, its intervals and its posterior.

Formulae: Wilson (1927) for the interval of a proportion; Clopper and Pearson (1934) if coverage must be guaranteed;
the Beta posterior of a uniform prior (Bayes, Laplace) for drawing a distribution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_counts, check_level, z_of
from evaweb.statistics.means import Average, average

__all__ = ["LEVEL", "Interval", "Posterior", "Proportion", "StatisticsError", "Summary"]


@dataclass(frozen=True, slots=True)
class Proportion:
    """`successes` out of `n`; `rate` and `interval` are None if n is 0."""

    successes: int
    n: int
    rate: float | None
    interval: Interval | None


@dataclass(frozen=True, slots=True)
class Posterior:
    """Posterior of a success rate after x of n with a uniform prior: Beta(1 + x, 1 + n - x)."""

    a: float
    b: float

    @property
    def mean(self) -> float:
        """Posterior mean, (x + 1) / (n + 2)."""
        return self.a / (self.a + self.b)

    def interval(self, level: float = LEVEL) -> Interval:
        """Return the equal-tailed credible interval."""
        check_level(level)
        from scipy.special import betaincinv

        tail = (1 - level) / 2
        return Interval(
            float(betaincinv(self.a, self.b, tail)), float(betaincinv(self.a, self.b, 1 - tail)), level
        )

    def density(self, rates: Sequence[float]) -> list[float]:
        """Return the density at each of `rates` (0 to 1), for a violin plot."""
        from scipy.stats import beta

        return [float(value) for value in beta.pdf(rates, self.a, self.b)]


@dataclass(frozen=True, slots=True)
class Summary:
    """Statistics of a set of scored trials; a value is None if there is no data for it."""

    success: Proportion
    mean_score: float | None
    median_duration_s: float | None
    smoothness: Average | None = None


def proportion(successes: int, n: int, level: float = LEVEL) -> Proportion:
    """Return `successes` out of `n` with the Wilson interval; n may be 0."""
    if n == 0 and successes == 0:
        return Proportion(0, 0, None, None)
    interval = wilson(successes, n, level)
    return Proportion(successes, n, successes / n, interval)


def wilson(successes: int, n: int, level: float = LEVEL) -> Interval:
    """Return Wilson's score interval of a proportion; within 0 to 1, usable at 0/n and n/n too.

    Raises:
        StatisticsError: If n is below 1 or successes are outside 0 to n.
    """
    check_counts(successes, n)
    check_level(level)
    z2 = z_of(level) ** 2
    p = successes / n
    centre = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = math.sqrt(z2) / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
    low = 0.0 if successes == 0 else max(0.0, centre - half)  # exact; rounding would leave 1e-17
    high = 1.0 if successes == n else min(1.0, centre + half)
    return Interval(low, high, level)


def clopper_pearson(successes: int, n: int, level: float = LEVEL) -> Interval:
    """Return the exact interval of a proportion: its coverage is at least `level` at every true rate."""
    check_counts(successes, n)
    check_level(level)
    from scipy.special import betaincinv

    tail = (1 - level) / 2
    low = 0.0 if successes == 0 else float(betaincinv(successes, n - successes + 1, tail))
    high = 1.0 if successes == n else float(betaincinv(successes + 1, n - successes, 1 - tail))
    return Interval(low, high, level)


def posterior(successes: int, n: int) -> Posterior:
    """Return the posterior of the rate after `successes` out of `n`; n may be 0."""
    if n != 0 or successes != 0:
        check_counts(successes, n)
    return Posterior(1.0 + successes, 1.0 + n - successes)


def summary(
    outcomes: Sequence[bool],
    scores: Sequence[float],
    durations: Sequence[float],
    smoothness: Sequence[float] = (),
) -> Summary:
    """Return the summary of scored trials that belong together, such as those of one checkpoint at one scene.

    The summary has the success rate, mean score (0 to 1), median duration [s] and mean smoothness (SPARC). A value is
    None if it is known of no trial.
    """
    return Summary(
        proportion(sum(map(bool, outcomes)), len(outcomes)),
        math.fsum(scores) / len(scores) if scores else None,
        float(median(durations)) if durations else None,
        average(smoothness),
    )
