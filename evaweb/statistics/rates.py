"""Rates of events over time: units per hour, mean time between interventions.

Formula: the exact interval of a Poisson rate (Garwood 1936), by the Gamma distribution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_level

HOUR = 3600.0


@dataclass(frozen=True, slots=True)
class Rate:
    """`events` in `exposure` [s], as a rate per hour with its interval."""

    events: int
    exposure: float
    per_hour: float
    interval: Interval

    @property
    def mean_time(self) -> float | None:
        """Mean time between events [s]; None without events."""
        return HOUR / self.per_hour if self.events else None

    @property
    def mean_time_interval(self) -> Interval:
        """Interval of the mean time between events [s]; its upper end is infinite without events."""
        high = HOUR / self.interval.low if self.interval.low > 0 else math.inf
        return Interval(HOUR / self.interval.high, high, self.interval.level)


def rate(events: int, exposure: float, level: float = LEVEL) -> Rate:
    """Return the rate of `events` in `exposure` [s] of running."""
    check_level(level)
    if events < 0:
        raise StatisticsError(f"{events} events; allowed: 0 or more")
    if not (math.isfinite(exposure) and exposure > 0):
        raise StatisticsError(f"exposure = {exposure} s; allowed: above 0")
    from scipy.special import gammaincinv

    tail = (1 - level) / 2
    low = float(gammaincinv(events, tail)) if events else 0.0
    high = float(gammaincinv(events + 1, 1 - tail))
    hours = exposure / HOUR
    return Rate(events, exposure, events / hours, Interval(low / hours, high / hours, level))
