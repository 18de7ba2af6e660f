"""Common parts of all methods: an interval, the allowed counts, and the error that says so."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

LEVEL = 0.95


class StatisticsError(ValueError):
    """Data that cannot be, or from which a method says nothing."""


@dataclass(frozen=True, slots=True)
class Interval:
    """From `low` to `high`, both included, at a confidence of `level`."""

    low: float
    high: float
    level: float = LEVEL

    def holds(self, value: float) -> bool:
        """True if `value` lies in it."""
        return self.low <= value <= self.high


def z_of(level: float) -> float:
    """Number of standard deviations to each side that hold `level` of a normal distribution."""
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
