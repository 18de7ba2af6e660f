"""Time to success within a horizon: cumulative share of successes, and restricted mean that includes failures.

A failed trial counts as never successful; with a longer time limit it would have been a different trial. Nothing is
censored before the horizon, so shares are counts over all trials, and the mean is computed from the times themselves
(the restricted mean of Royston and Parmar 2013, without an estimated survival curve).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import LEVEL, Interval, StatisticsError
from evaweb.statistics.bounded import bounded_mean
from evaweb.statistics.proportions import wilson

Times = Sequence[float | None]  # time to success of each trial [s]; None: it failed


@dataclass(frozen=True, slots=True)
class Curve:
    """Share of the trials that have succeeded by a time.

    The share is 0 before the first time. It is `share[i]` from `times[i]` [s] until the next time, and `low[i]` to
    `high[i]` is the pointwise Wilson interval. The last time is at most `until` [s], the horizon of all `n` trials.
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
        """Time at which half of the trials have succeeded [s]; None if that share is not reached."""
        return next((t for t, s in zip(self.times, self.share, strict=True) if s >= 0.5), None)


@dataclass(frozen=True, slots=True)
class RestrictedMean:
    """Mean time to success [s]; a trial without success by `until` [s] counts as `until`."""

    value: float
    interval: Interval
    until: float


def cumulative_incidence(times: Times, until: float, level: float = LEVEL) -> Curve:
    """Return the curve of trials with these `times` to success [s], up to `until` [s]."""
    observed = [t for t in censor_at_horizon(times, until) if t is not None]
    n, steps = len(times), sorted(set(observed))
    counts = [sum(t <= step for t in observed) for step in steps]
    ends = [wilson(count, n, level) for count in counts]
    return Curve(
        tuple(steps),
        tuple(count / n for count in counts),
        tuple(end.low for end in ends),
        tuple(end.high for end in ends),
        n,
        len(observed),
        until,
    )


def restricted_mean(times: Times, until: float, *, seed: int, level: float = LEVEL) -> RestrictedMean:
    """Return the restricted mean of `times` [s] up to `until` [s]."""
    lasted = {"all": [until if t is None else t for t in censor_at_horizon(times, until)]}
    mean = bounded_mean(lasted, seed=seed, bounds=(0.0, until), level=level)
    return RestrictedMean(mean.value, mean.interval, until)


def censor_at_horizon(times: Times, until: float) -> list[float | None]:
    """Return `times` [s] with None for each beyond `until` [s].

    Raises:
        StatisticsError: If there is no trial, a time is negative or not finite, or `until` is not above 0.
    """
    if not (math.isfinite(until) and until > 0):
        raise StatisticsError(f"until = {until} s; allowed: above 0")
    if not times:
        raise StatisticsError("no trial: a time to success needs at least one")
    wrong = [t for t in times if t is not None and not (math.isfinite(t) and t >= 0)]
    if wrong:
        raise StatisticsError(f"a time to success of {wrong[0]} s; allowed: 0 or more")
    return [t if t is not None and t <= until else None for t in times]
