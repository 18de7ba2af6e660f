"""Strategy `naive`: query during motion; the newest chunk replaces the plan."""

from __future__ import annotations

from typing import Literal

from runtime.motion.timeline import DimensionKinds, Timeline, single_contribution
from runtime.strategies.base import ArrivedChunk, Merge, Paced, Placement, Query, StrategyParameters
from runtime.strategies.placement import place

USES = frozenset({"execution_horizon", "inference_rate", "k_max"})


class Config(StrategyParameters):
    """Request while moving; the newest chunk replaces the remaining plan, even with a jump."""

    kind: Literal["naive"] = "naive"


class NaiveMerge(Merge):
    """Merge that drops stale rows and replaces the whole plan from the first free step on."""

    def __init__(self, execution_horizon: int | None, k_max: int | None) -> None:
        self._horizon = execution_horizon
        self._k_max = k_max

    def place(self, timeline: Timeline, arrival: ArrivedChunk, free_step: int) -> Placement:
        return place(arrival, free_step, self._horizon, self._k_max)

    def apply(self, timeline: Timeline, placed: Placement) -> None:
        timeline.replace(
            placed.first, placed.rows, single_contribution(placed.merged.chunk_id, len(placed.rows))
        )


def query(config: Config) -> Query:
    """Return the part of the strategy that decides when to query."""
    return Paced(config.inference_rate)


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """Return the part of the strategy that merges chunks."""
    return NaiveMerge(config.execution_horizon, config.k_max)
