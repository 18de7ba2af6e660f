"""Counts in, estimates with intervals out: pure functions, no Django; numpy and scipy are imported when needed.

Formulae: Wilson (1927) for the interval of a proportion; Clopper and Pearson (1934) where a guarantee is wanted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist, median

LEVEL = 0.95


class StatisticsError(ValueError):
    """Counts that cannot be."""


@dataclass(frozen=True, slots=True)
class Interval:
    """From `low` to `high`, both included, at a confidence of `level`."""

    low: float
    high: float
    level: float = LEVEL


@dataclass(frozen=True, slots=True)
class Proportion:
    """`successes` out of `n`; `rate` and `interval` are None where n is 0: nothing is known then."""

    successes: int
    n: int
    rate: float | None
    interval: Interval | None


@dataclass(frozen=True, slots=True)
class Summary:
    """What a set of scored trials says; the figures are None where there is nothing they could be made from."""

    success: Proportion
    mean_score: float | None
    median_duration_s: float | None


def proportion(successes: int, n: int, level: float = LEVEL) -> Proportion:
    """`successes` out of `n` with its Wilson interval."""
    if n == 0 and successes == 0:
        return Proportion(0, 0, None, None)
    interval = wilson(successes, n, level)
    return Proportion(successes, n, successes / n, interval)


def wilson(successes: int, n: int, level: float = LEVEL) -> Interval:
    """Wilson's score interval of a proportion; never wider than 0 to 1, sensible also at 0/n and n/n.

    Raises StatisticsError for n below 1 and successes outside 0 to n.
    """
    _check(successes, n, level)
    z2 = _z(level) ** 2
    p = successes / n
    centre = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = math.sqrt(z2) / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
    low = 0.0 if successes == 0 else max(0.0, centre - half)  # exact there, rounding would leave 1e-17
    high = 1.0 if successes == n else min(1.0, centre + half)
    return Interval(low, high, level)


def clopper_pearson(successes: int, n: int, level: float = LEVEL) -> Interval:
    """The exact interval of a proportion: covers with at least `level` whatever the truth is."""
    _check(successes, n, level)
    from scipy.special import betaincinv

    tail = (1 - level) / 2
    low = 0.0 if successes == 0 else float(betaincinv(successes, n - successes + 1, tail))
    high = 1.0 if successes == n else float(betaincinv(successes + 1, n - successes, 1 - tail))
    return Interval(low, high, level)


def summary(outcomes: Sequence[bool], scores: Sequence[float], durations: Sequence[float]) -> Summary:
    """Of the scored trials of one cell: success, score (0 to 1) and duration [s] of each, where it is known."""
    return Summary(
        proportion(sum(map(bool, outcomes)), len(outcomes)),
        math.fsum(scores) / len(scores) if scores else None,
        float(median(durations)) if durations else None,
    )


def _z(level: float) -> float:
    return NormalDist().inv_cdf(0.5 + level / 2)


def _check(successes: int, n: int, level: float) -> None:
    if n < 1:
        raise StatisticsError(f"n = {n}: a proportion needs at least one trial")
    if not 0 <= successes <= n:
        raise StatisticsError(f"{successes} successes in {n} trials; allowed: 0 to {n}")
    if not 0 < level < 1:
        raise StatisticsError(f"level = {level}; allowed: above 0 and below 1")
