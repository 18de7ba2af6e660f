"""Metrics of the policy over a run: latencies, measured delays, mistimed and dropped chunks."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any, TypeVar

import numpy as np

from runtime.ipc.messages import MergeResult

_KEPT = 20_000  # responses; half an hour back to back at 10 Hz
_SHOWN = 60
_JUDGED = 300  # responses for the metrics of a page; the record contains the whole run

Number = TypeVar("Number", int, float)


def quantile(values: Sequence[float], percent: float) -> float:
    """Return the percentile of `values`, interpolated linearly; NaN if there are none.

    It is computed without numpy, which is slower for the few hundred values of a call, ten times a second.
    """
    if not values:
        return math.nan
    ordered = sorted(values)
    place = (len(ordered) - 1) * percent / 100.0
    below = int(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (ordered[above] - ordered[below]) * (place - below)


class PolicyMetrics:
    """Metrics since the beginning of a run; memory is bounded, counts are not."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Clear all metrics."""
        self.ik: dict[str, Any] = {}  # of the newest response
        self.poses: dict[str, Any] = {}  # of all responses: solved rows, flagged rows, largest errors
        self.answers = self.dropped = self.mistimed = self.starved = self.lost = 0
        self.latencies: deque[float] = deque(maxlen=_KEPT)  # on the station's clock [s]
        self.wall_latencies: deque[float] = deque(maxlen=_KEPT)  # on the machine's clock [s]
        self.ages: deque[float] = deque(maxlen=_KEPT)  # age of the observation at the request [s]
        self.delays: deque[int] = deque(maxlen=_KEPT)  # control steps, measured

    def add_response(
        self,
        seconds: float,
        age: float | None = None,
        ik: Mapping[str, Any] | None = None,
        wall_seconds: float | None = None,
    ) -> None:
        """Add a response with its latency `seconds` on the station's clock, `wall_seconds` on the machine's [s].

        `age` is the age of its observation at the request [s], None if unknown. `ik` are the figures of its poses
        (`requests.ik_figures`); {} or None for a chunk of joints.
        """
        for name, figure in (ik or {}).items():
            before = self.poses.get(name, 0)
            self.poses[name] = max(before, figure) if name.startswith("worst") else before + figure
        self.ik = dict(ik or {})
        self.answers += 1
        self.latencies.append(seconds)
        if wall_seconds is not None:
            self.wall_latencies.append(wall_seconds)
        if age is not None:
            self.ages.append(age)

    def count_starved(self) -> None:
        """Count a start of starvation."""
        self.starved += 1

    def count_lost(self) -> None:
        """Count a loss of the policy."""
        self.lost += 1

    def add_merge(self, merged: MergeResult) -> None:
        """Add a merged or dropped chunk."""
        self.delays.append(merged.delay)
        self.mistimed += merged.mistimed > 0
        self.dropped += bool(merged.dropped)

    def recent(self) -> dict[str, Any]:
        """Return metrics of the last responses for a page: latencies [ms], delays [steps]."""
        latencies, delays = _last(self.latencies, _JUDGED), _last(self.delays, _JUDGED)
        return {
            "latencies_ms": [round(seconds * 1000, 1) for seconds in latencies[-_SHOWN:]],
            "delays": delays[-_SHOWN:],
            "latency_p50_ms": quantile(latencies, 50) * 1000,
            "latency_p90_ms": quantile(latencies, 90) * 1000,
            "delay_p50": quantile(delays, 50),
            "delay_max": max(delays, default=math.nan),
            "ik": dict(self.ik),
        }

    def figures(self) -> dict[str, Any]:
        """Return metrics of the whole run, None for values that were not measured."""
        latencies, delays, ages = list(self.latencies), list(self.delays), list(self.ages)
        return {
            "answers": self.answers,
            "dropped": self.dropped,
            "mistimed": self.mistimed,
            "starved": self.starved,
            "lost": self.lost,
            "latency_ms": _spread([seconds * 1000 for seconds in latencies]),
            "wall_latency_ms": _spread([seconds * 1000 for seconds in self.wall_latencies]),
            "delay_steps": _spread(delays),
            "ik": dict(self.poses) or None,
            "observation_age_ms": _spread([seconds * 1000 for seconds in ages]),
        }


def _last(values: deque[Number], count: int) -> list[Number]:
    """Return the newest `count` values, oldest first, in time independent of the total."""
    return list(islice(reversed(values), count))[::-1]


def _spread(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    p50, p90, p99 = (float(value) for value in np.percentile(np.array(values), (50, 90, 99)))
    return {"p50": p50, "p90": p90, "p99": p99, "max": float(max(values))}
