"""How the policy did over a run: latencies, measured delays, what was shifted or dropped."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.messages import ChunkMerged

_KEPT = 20_000  # answers; half an hour back to back at 10 Hz
_SHOWN = 60


def quantile(values: Sequence[float], percent: float) -> float:
    """The percentile of `values`, NaN where there are none."""
    return float(np.percentile(np.array(values), percent)) if values else math.nan


class Tally:
    """Counts from the beginning of a run; memory is bounded, counts are not."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.answers = self.dropped = self.mistimed = self.starved = self.lost = 0
        self.latencies: deque[float] = deque(maxlen=_KEPT)  # [s]
        self.ages: deque[float] = deque(maxlen=_KEPT)  # of what the policy was shown when it was asked [s]
        self.delays: deque[int] = deque(maxlen=_KEPT)  # control steps, measured

    def answered(self, seconds: float, age: float | None = None) -> None:
        """An answer came after so long [s]; what was shown was so old when the policy was asked [s]."""
        self.answers += 1
        self.latencies.append(seconds)
        if age is not None:
            self.ages.append(age)

    def merged(self, merged: ChunkMerged) -> None:
        """Control has placed it, or dropped it."""
        self.delays.append(merged.delay)
        self.mistimed += merged.mistimed > 0
        self.dropped += bool(merged.dropped)

    def newest(self) -> dict[str, Any]:
        """The last answers, for a page: latencies [ms], delays [steps]."""
        return {
            "latencies_ms": [round(seconds * 1000, 1) for seconds in list(self.latencies)[-_SHOWN:]],
            "delays": list(self.delays)[-_SHOWN:],
        }

    def figures(self) -> dict[str, Any]:
        """The run in numbers, None where nothing was measured."""
        latencies, delays, ages = list(self.latencies), list(self.delays), list(self.ages)
        return {
            "answers": self.answers,
            "dropped": self.dropped,
            "mistimed": self.mistimed,
            "starved": self.starved,
            "lost": self.lost,
            "latency_ms": _spread([seconds * 1000 for seconds in latencies]),
            "delay_steps": _spread(delays),
            "observation_age_ms": _spread([seconds * 1000 for seconds in ages]),
        }


def _spread(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    p50, p90, p99 = (float(value) for value in np.percentile(np.array(values), (50, 90, 99)))
    return {"p50": p50, "p90": p90, "p99": p99, "max": float(max(values))}
