"""Mean of one number per trial, with Student's interval (1908)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_level


@dataclass(frozen=True, slots=True)
class Average:
    """Mean of `n` values; `interval` is None if their spread is unknown (one value, or all equal)."""

    n: int
    value: float
    interval: Interval | None


def average(values: Sequence[float], level: float = LEVEL) -> Average | None:
    """Return the mean of `values`, or None if there are none.

    Raises:
        StatisticsError: If a value is not finite.
    """
    check_level(level)
    wrong = next((value for value in values if not math.isfinite(value)), None)
    if wrong is not None:
        raise StatisticsError(f"a value of {wrong}; allowed: finite numbers")
    n = len(values)
    if not n:
        return None
    mean = math.fsum(values) / n
    if n == 1 or min(values) == max(values):
        return Average(n, mean, None)
    from scipy.special import stdtrit

    squares = math.fsum((value - mean) ** 2 for value in values)
    half = float(stdtrit(n - 1, 0.5 + level / 2)) * math.sqrt(squares / (n - 1) / n)
    return Average(n, mean, Interval(mean - half, mean + half, level))
