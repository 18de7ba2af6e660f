"""`naive`: ask while moving; the newest chunk replaces the rest of the old one."""

from __future__ import annotations

from typing import Literal

from runtime.motion.timeline import DimensionKinds, Timeline, single_contribution
from runtime.strategies.base import ArrivedChunk, Merge, Paced, Placement, Query, StrategyParameters
from runtime.strategies.placing import place

USES = frozenset({"execution_horizon", "inference_rate", "k_max"})


class Config(StrategyParameters):
    """Ask while moving; the newest chunk replaces the rest of the old one, with whatever jump there is."""

    kind: Literal["naive"] = "naive"


class NaiveMerge(Merge):
    """Drops what is stale; from the first free step on the newest chunk is the whole plan."""

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
    """The asking half."""
    return Paced(config.inference_rate)


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """The merging half."""
    return NaiveMerge(config.execution_horizon, config.k_max)
