"""Shared parts of all methods: the interval, checks of counts and levels, and the exception."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

LEVEL = 0.95


class StatisticsError(ValueError):
    """Error for invalid data, and for data from which a method cannot estimate anything."""


@dataclass(frozen=True, slots=True)
class Interval:
    """Closed interval from `low` to `high` with confidence `level`."""

    low: float
    high: float
    level: float = LEVEL

    def holds(self, value: float) -> bool:
        """Return True if `value` lies in the interval, ends included."""
        return self.low <= value <= self.high


def z_of(level: float) -> float:
    """Return the half-width [standard deviations] of the central interval with probability `level` of a normal law."""
    return NormalDist().inv_cdf(0.5 + level / 2)


def check_counts(successes: int, n: int) -> None:
    """Raise StatisticsError unless 0 <= successes <= n and n >= 1."""
    if n < 1:
        raise StatisticsError(f"n = {n}: a proportion needs at least one trial")
    if not 0 <= successes <= n:
        raise StatisticsError(f"{successes} successes in {n} trials; allowed: 0 to {n}")


def check_level(level: float) -> None:
    """Raise StatisticsError unless 0 < level < 1."""
    if not 0 < level < 1:
        raise StatisticsError(f"level = {level}; allowed: above 0 and below 1")


def check_alpha(alpha: float) -> None:
    """Raise StatisticsError unless 0 < alpha < 1."""
    if not 0 < alpha < 1:
        raise StatisticsError(f"alpha = {alpha}; allowed: above 0 and below 1")


def check_share(name: str, value: float) -> None:
    """Raise StatisticsError unless `value` is a number from 0 to 1."""
    if not (math.isfinite(value) and 0 <= value <= 1):
        raise StatisticsError(f"{name} = {value}; allowed: 0 to 1")
