"""`sync`: ask, execute the answer in order, ask again; the robot stands while it waits."""

from __future__ import annotations

from typing import Literal

from runtime.motion.timeline import DimensionKinds, Timeline, single_contribution
from runtime.strategies.base import ArrivedChunk, Merge, Placement, Progress, Query, StrategyParameters
from runtime.strategies.placing import drop, place

USES = frozenset({"execution_horizon"})


class Config(StrategyParameters):
    """Ask, execute the answer in order, ask again; the robot stands while it waits."""

    kind: Literal["sync"] = "sync"


class SyncQuery(Query):
    """Asks when nothing is left to execute."""

    requests_while_stopped = True

    def should_request(self, progress: Progress) -> bool:
        return progress.remaining == 0 and not progress.in_flight


class SyncMerge(Merge):
    """Executes what was asked while the robot stood, whole; refuses what was asked while it moved."""

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
    """The asking half."""
    return SyncQuery()


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """The merging half."""
    return SyncMerge(config.execution_horizon)
