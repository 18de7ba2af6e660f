"""Time to success within a horizon: the share that has succeeded by each time, and the mean with failures in it.

A trial that failed never succeeds: had it been given longer, it would have been another trial. Nothing is cut off
before the horizon, so that shares are counts of all trials, and the mean is that of the times themselves (the
restricted mean of Royston and Parmar 2013, without anything to estimate).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import LEVEL, Interval, StatisticsError
from evaweb.statistics.bounded import bounded_mean
from evaweb.statistics.proportions import wilson

Times = Sequence[float | None]  # when each trial succeeded [s]; None: it did not


@dataclass(frozen=True, slots=True)
class Curve:
    """Share that has succeeded: from `times[i]` [s] on it is `share[i]`, with its pointwise Wilson interval.

    Before the first time it is 0; the last one is at or before `until` [s], up to which all `n` trials are known.
    """

    times: tuple[float, ...]
    share: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    n: int
    successes: int
    until: float

    @property
    def median(self) -> float | None:
        """When half have succeeded [s]; None where that was never reached."""
        return next((t for t, s in zip(self.times, self.share, strict=True) if s >= 0.5), None)


@dataclass(frozen=True, slots=True)
class RestrictedMean:
    """Mean time to success [s], where a trial that has not succeeded by `until` [s] counts for so much."""

    value: float
    interval: Interval
    until: float


def cumulative_incidence(times: Times, until: float, level: float = LEVEL) -> Curve:
    """The curve of trials that succeeded at `times` [s], up to `until` [s]."""
    known = [t for t in censor_at_horizon(times, until) if t is not None]
    n, steps = len(times), sorted(set(known))
    counts = [sum(t <= step for t in known) for step in steps]
    ends = [wilson(count, n, level) for count in counts]
    return Curve(
        tuple(steps),
        tuple(count / n for count in counts),
        tuple(end.low for end in ends),
        tuple(end.high for end in ends),
        n,
        len(known),
        until,
    )


def restricted_mean(times: Times, until: float, *, seed: int, level: float = LEVEL) -> RestrictedMean:
    """The mean of `times` [s] up to `until` [s]."""
    lasted = {"all": [until if t is None else t for t in censor_at_horizon(times, until)]}
    found = bounded_mean(lasted, seed=seed, bounds=(0.0, until), level=level)
    return RestrictedMean(found.value, found.interval, until)


def censor_at_horizon(times: Times, until: float) -> list[float | None]:
    """`times` [s] with None for each beyond `until` [s]; StatisticsError for what can be no time, or none at all."""
    if not (math.isfinite(until) and until > 0):
        raise StatisticsError(f"until = {until} s; allowed: above 0")
    if not times:
        raise StatisticsError("no trial: a time to success needs at least one")
    wrong = [t for t in times if t is not None and not (math.isfinite(t) and t >= 0)]
    if wrong:
        raise StatisticsError(f"a time to success of {wrong[0]} s; allowed: 0 or more")
    return [t if t is not None and t <= until else None for t in times]
