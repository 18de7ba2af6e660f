"""Means of bounded outcomes, with intervals that are valid for small samples of any distribution.

Formula: Gaffke (2005), two-sided. In each draw the outcomes get random weights, which are the gaps between sorted
uniform numbers. There is one more gap than outcomes: its weight goes to the least possible value for the lower end of
the interval, to the largest possible value for the upper end. For outcomes of 0 and 1 the ends are those of Clopper and
Pearson.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_level

DRAWS = 10_000


@dataclass(frozen=True, slots=True)
class BoundedMean:
    """Mean with its interval."""

    value: float
    interval: Interval


def bounded_mean(
    strata: Mapping[str, Sequence[float]],
    *,
    seed: int,
    bounds: tuple[float, float] = (0.0, 1.0),
    level: float = LEVEL,
    draws: int = DRAWS,
) -> BoundedMean:
    """Return the mean of the strata's mean outcomes, each stratum with equal weight.

    Raises:
        StatisticsError: If there is no stratum, a stratum is empty, or an outcome lies outside `bounds`.
    """
    check_level(level)
    import numpy as np

    low, high = bounds
    empty = [name for name, outcomes in strata.items() if not len(outcomes)]
    if not strata or empty:
        raise StatisticsError(f"{empty[0]!r} has no trial" if empty else "no trial")
    samples = [np.asarray(outcomes, dtype=float) for _, outcomes in sorted(strata.items())]
    wrong = [float(outcome) for outcomes in samples for outcome in outcomes if not low <= outcome <= high]
    if wrong:
        raise StatisticsError(f"an outcome of {wrong[0]}; allowed: {low:g} to {high:g}")
    chance = np.random.default_rng(seed)
    lower, upper = np.zeros(draws), np.zeros(draws)
    for outcomes in samples:
        levels, counts = np.unique((outcomes - low) / (high - low), return_counts=True)
        weights, more = chance.gamma(counts, size=(draws, len(levels))), chance.exponential(size=draws)
        total, drawn = weights.sum(axis=1) + more, weights @ levels
        lower += drawn / total / len(samples)
        upper += (drawn + more) / total / len(samples)
    value = float(np.mean([outcomes.mean() for outcomes in samples]))
    ends = (
        float(np.quantile(side, share))
        for side, share in ((lower, (1 - level) / 2), (upper, (1 + level) / 2))
    )
    least, most = (min(high, max(low, low + (high - low) * end)) for end in ends)
    return BoundedMean(value, Interval(least, most, level))
