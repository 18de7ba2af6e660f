"""`sync`: ask, execute the answer in order, ask again; the robot stands while it waits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from runtime.strategies.base import Arrival, Merge, Merged, Progress, Query, StrategyParameters, single
from runtime.timeline import Timeline


class Config(StrategyParameters):
    """Settings of the sync strategy."""

    kind: Literal["sync"] = "sync"


class SyncQuery(Query):
    """Asks when nothing is left to execute."""

    def wants(self, progress: Progress) -> bool:
        return progress.remaining == 0 and not progress.in_flight


class SyncMerge(Merge):
    """Anchors row 0 at the first free step: while the robot stands nothing is stale."""

    waits = True

    def __init__(self, execution_horizon: int | None) -> None:
        self._horizon = execution_horizon

    def __call__(self, timeline: Timeline, arrival: Arrival, free_step: int) -> Merged:
        rows = arrival.rows[: self._horizon]
        timeline.replace(free_step, rows, single(arrival.chunk_id, len(rows)))
        targets = np.full(len(arrival.rows), -1, np.int64)
        targets[: len(rows)] = free_step + np.arange(len(rows))
        delay = free_step - arrival.observation_step
        return Merged(arrival.chunk_id, free_step, delay, targets)


def query(config: Config) -> Query:
    """The asking half."""
    return SyncQuery()


def merge(config: Config, switched: Sequence[int]) -> Merge:
    """The merging half; `switched` are the binary gripper dimensions."""
    return SyncMerge(config.execution_horizon)
