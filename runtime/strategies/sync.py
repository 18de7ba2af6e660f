"""Strategy `sync`: query, execute the whole chunk, query again; the robot holds while it waits."""

from __future__ import annotations

from typing import Literal

from runtime.motion.timeline import DimensionKinds, Timeline, single_contribution
from runtime.strategies.base import ArrivedChunk, Merge, Placement, Progress, Query, StrategyParameters
from runtime.strategies.placement import drop, place

USES = frozenset({"execution_horizon"})


class Config(StrategyParameters):
    """Request, execute the response in order, request again; the robot stands still while it waits."""

    kind: Literal["sync"] = "sync"


class SyncQuery(Query):
    """Query when no planned step remains."""

    requests_while_stopped = True

    def should_request(self, progress: Progress) -> bool:
        return progress.remaining == 0 and not progress.in_flight


class SyncMerge(Merge):
    """Merge that uses a whole chunk if it was requested while the robot was stopped, and drops it otherwise."""

    requests_while_stopped = True

    def __init__(self, execution_horizon: int | None) -> None:
        self._horizon = execution_horizon

    def place(self, timeline: Timeline, arrival: ArrivedChunk, free_step: int) -> Placement:
        if arrival.requested_while_stopped:
            return place(arrival, free_step, self._horizon)
        left = timeline.remaining(free_step)
        then = (
            f"the {left} steps still planned are finished first" if left else "the next is asked as it stands"
        )
        return drop(arrival, free_step, f"asked while the robot moved, and sync waits: {then}")

    def apply(self, timeline: Timeline, placed: Placement) -> None:
        timeline.replace(
            placed.first, placed.rows, single_contribution(placed.merged.chunk_id, len(placed.rows))
        )


def query(config: Config) -> Query:
    """Return the part of the strategy that decides when to query."""
    return SyncQuery()


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """Return the part of the strategy that merges chunks."""
    return SyncMerge(config.execution_horizon)
