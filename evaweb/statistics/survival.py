"""Time to success: curves, restricted means and their comparison, with trials that were cut off counted as such.

A trial that ended without success (its time was up, or it was stopped) is censored at its end: success might have come
later. Formulae: Kaplan and Meier (1958), Greenwood's variance, log-rank test (by scipy); restricted mean survival time
(Royston and Parmar 2013).
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_level, z_of

if TYPE_CHECKING:
    from scipy.stats import CensoredData


@dataclass(frozen=True, slots=True)
class Curve:
    """Share that has not succeeded yet: from `times[i]` [s] on it is `share[i]`, with its pointwise interval.

    Before the first time it is 1. `at_risk[i]` trials were still going on just before `times[i]`.
    """

    times: tuple[float, ...]
    share: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    at_risk: tuple[int, ...]
    n: int
    successes: int

    @property
    def median(self) -> float | None:
        """When half have succeeded [s]; None where that was never reached."""
        return next((t for t, s in zip(self.times, self.share, strict=True) if s <= 0.5), None)


def kaplan_meier(durations: Sequence[float], succeeded: Sequence[bool], level: float = LEVEL) -> Curve:
    """The curve of trials that took `durations` [s] and `succeeded` or were cut off; log-log intervals."""
    check_level(level)
    import numpy as np

    data = _censored(durations, succeeded)
    from scipy.stats import ecdf

    survival = ecdf(data).sf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # where it is undefined, it is defined below
        interval = survival.confidence_interval(level, method="log-log")
    times = np.asarray(survival.quantiles)
    last, low, high = (
        np.asarray(survival.probabilities),
        *(np.asarray(side.probabilities) for side in (interval.low, interval.high)),
    )
    # Where the curve is at 1 or 0 the log-log interval is not a number: nothing, or everything, is left there.
    low = np.where(np.isnan(low), np.where(last >= 1, 1.0, 0.0), low)
    high = np.where(np.isnan(high), np.where(last >= 1, 1.0, last), high)
    ends = np.asarray(durations, dtype=float)
    return Curve(
        tuple(times.tolist()),
        tuple(last.tolist()),
        tuple(low.tolist()),
        tuple(high.tolist()),
        tuple(int((ends >= t).sum()) for t in times),
        len(ends),
        int(sum(map(bool, succeeded))),
    )


@dataclass(frozen=True, slots=True)
class RestrictedMean:
    """Mean time to success [s], where no trial counts for more than `until` [s]."""

    value: float
    interval: Interval
    until: float


def restricted_mean(
    durations: Sequence[float], succeeded: Sequence[bool], until: float, level: float = LEVEL
) -> RestrictedMean:
    """The area below the Kaplan-Meier curve up to `until` [s], above 0 and not beyond the last trial's end."""
    curve = kaplan_meier(durations, succeeded, level)
    longest = max(durations)
    if not 0 < until <= longest:
        raise StatisticsError(
            f"until = {until:g} s; allowed: above 0, and at most {longest:g} s, the longest trial"
        )
    steps = [(0.0, 1.0), *zip(curve.times, curve.share, strict=True)]
    steps = [(t, s) for t, s in steps if t < until] + [(until, 0.0)]
    areas = [s * (after - t) for (t, s), (after, _) in pairwise(steps)]
    beyond = min(math.fsum(areas), until)  # each area is rounded
    ended = Counter(d for d, ok in zip(durations, succeeded, strict=True) if ok)
    risk = dict(zip(curve.times, curve.at_risk, strict=True))
    variance = 0.0
    for i, (t, _) in enumerate(steps[1:-1], start=1):
        beyond_t = math.fsum(areas[i:])
        at_risk = risk[t]
        events = ended[t]
        if at_risk > events:
            variance += beyond_t**2 * events / (at_risk * (at_risk - events))
    half = z_of(level) * math.sqrt(variance)
    return RestrictedMean(beyond, Interval(max(0.0, beyond - half), min(until, beyond + half), level), until)


def log_rank(
    first: tuple[Sequence[float], Sequence[bool]], second: tuple[Sequence[float], Sequence[bool]]
) -> float:
    """Two-sided probability of curves as different as these, each (durations [s], succeeded), if they were the same."""
    one, other = _censored(*first), _censored(*second)
    if not any(first[1]) and not any(second[1]):
        return 1.0  # nobody ever succeeded: nothing tells the two apart
    from scipy.stats import logrank

    return float(logrank(one, other).pvalue)


def _censored(durations: Sequence[float], succeeded: Sequence[bool]) -> CensoredData:
    if len(durations) != len(succeeded):
        raise StatisticsError(f"{len(durations)} durations of {len(succeeded)} trials")
    if not durations:
        raise StatisticsError("no trial: a time to success needs at least one")
    wrong: list[Any] = [d for d in durations if not (math.isfinite(d) and d >= 0)]
    if wrong:
        raise StatisticsError(f"duration {wrong[0]} s; allowed: 0 or more")
    from scipy.stats import CensoredData

    return CensoredData(
        uncensored=[d for d, ok in zip(durations, succeeded, strict=True) if ok],
        right=[d for d, ok in zip(durations, succeeded, strict=True) if not ok],
    )
