"""`async`: ask while moving, blend the new chunk over the rest of the old one.

The linear overlap blend over the whole overlap ("all") is the published scheme of asynchronous chunk execution;
the default window is shorter because "all" takes over 30 steps to follow a change of mind.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from runtime.strategies.base import Arrival, Merge, Merged, Progress, Query, StrategyParameters, mixed
from runtime.timeline import Timeline, overlap_blend


class Config(StrategyParameters):
    """Settings of the async strategy."""

    kind: Literal["async"] = "async"


class AsyncQuery(Query):
    """Asks back to back, or at a rate, never with a request in flight."""

    def __init__(self, inference_rate: float | None) -> None:
        self._period = 0.0 if inference_rate is None else 1.0 / inference_rate

    def wants(self, progress: Progress) -> bool:
        return not progress.in_flight and progress.since_request >= self._period - 1e-6


class AsyncMerge(Merge):
    """Drops what is stale, puts every row on the step it was meant for, blends over the overlap."""

    def __init__(self, k_max: int | None, window: int | None, switched: Sequence[int]) -> None:
        self._k_max = k_max
        self._window = window
        self._switched = tuple(switched)

    def __call__(self, timeline: Timeline, arrival: Arrival, free_step: int) -> Merged:
        delay = free_step - arrival.observation_step
        horizon = len(arrival.rows)
        targets = np.full(horizon, -1, np.int64)
        if delay >= horizon:
            why = f"arrived {delay} steps after its observation, its {horizon} rows are all in the past"
            return Merged(arrival.chunk_id, free_step, delay, targets, dropped=why)
        stale = delay if self._k_max is None else min(delay, self._k_max)
        new = arrival.rows[stale:]
        old, makers = timeline.span(free_step)
        rows, weights = overlap_blend(old, new, self._window, self._switched)
        timeline.replace(free_step, rows, mixed(makers, weights.tolist(), arrival.chunk_id, len(rows)))
        targets[stale:] = free_step + np.arange(horizon - stale)
        return Merged(arrival.chunk_id, free_step, delay, targets, mistimed=delay - stale)


def query(config: Config) -> Query:
    """The asking half."""
    return AsyncQuery(config.inference_rate)


def merge(config: Config, switched: Sequence[int]) -> Merge:
    """The merging half; `switched` are the binary gripper dimensions, which never blend."""
    window = None if config.blend_window == "all" else config.blend_window
    return AsyncMerge(config.k_max, window, switched)
