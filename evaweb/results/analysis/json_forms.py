"""Values of statistics as JSON, for REST, for reports, and for the program that recomputes them.

Intervals are [low, high]; those under `gaffke` are from random draws and are reproduced only approximately.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evaweb.statistics.base import Interval
from evaweb.statistics.bounded import BoundedMean
from evaweb.statistics.difference import Difference
from evaweb.statistics.means import Average
from evaweb.statistics.proportions import Proportion
from evaweb.statistics.rates import Rate
from evaweb.statistics.sequential import Evidence


def write_interval(found: Interval | None) -> list[float] | None:
    """Return the interval as [low, high]."""
    return None if found is None else [found.low, found.high]


def write_proportion(found: Proportion) -> dict[str, Any]:
    """Return x of n with its Wilson interval; null if n is 0."""
    return {
        "successes": found.successes,
        "n": found.n,
        "rate": found.rate,
        "wilson": write_interval(found.interval),
    }


def write_proportions(found: Mapping[str, Proportion]) -> dict[str, Any]:
    """Return a dict of proportions as JSON, with the same keys."""
    return {name: write_proportion(rate) for name, rate in found.items()}


def write_gaffke(found: BoundedMean | Difference) -> dict[str, Any]:
    """Return the mean of bounded values, or difference of such means, with its interval by Gaffke's method."""
    return {"value": found.value, "gaffke": write_interval(found.interval)}


def write_newcombe(found: Difference) -> dict[str, Any]:
    """Return a difference of success rates with Newcombe's interval."""
    return {"value": found.value, "newcombe": write_interval(found.interval)}


def write_average(found: Average) -> dict[str, Any]:
    """Return a mean with its number of values and Student's interval."""
    return {"n": found.n, "mean": found.value, "student": write_interval(found.interval)}


def write_rate(found: Rate) -> dict[str, Any]:
    """Return a rate per hour with its number of events, time of exposure [s] and Garwood's interval."""
    return {
        "events": found.events,
        "exposure_s": found.exposure,
        "per_hour": found.per_hour,
        "garwood": write_interval(found.interval),
    }


def write_evidence(found: Evidence) -> dict[str, Any]:
    """Return the evidence: log e of both directions after each pair, their last p-values, and where it stops."""
    return {
        "pairs": found.pairs,
        "log_e_first": list(found.first),
        "log_e_second": list(found.second),
        "p_first": found.p_first[-1] if found.pairs else 1.0,
        "p_second": found.p_second[-1] if found.pairs else 1.0,
        "stop": found.stop,
        "winner": found.winner,
    }
