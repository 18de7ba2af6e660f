"""Strategy `async`: query during motion, and blend each new chunk with the remaining plan.

A linear blend over the whole overlap ("all") is the published scheme of asynchronous chunk execution. The default
window is shorter, because with "all" a change of the policy's intention takes effect only after 30 steps.
"""

from __future__ import annotations

from typing import Literal

from runtime.motion.timeline import (
    DimensionKinds,
    Timeline,
    mix_contributions,
    overlap_blend,
    single_contribution,
)
from runtime.strategies.base import ArrivedChunk, Merge, Paced, Placement, Query, StrategyParameters
from runtime.strategies.placement import place

USES = frozenset({"execution_horizon", "inference_rate", "k_max", "blend_window", "blend_shape"})


class Config(StrategyParameters):
    """Request while moving; a new chunk is blended into the remaining plan."""

    kind: Literal["async"] = "async"


class OverlapMerge(Merge):
    """Merge that drops stale rows, uses every row at its intended step, and blends over the overlap."""

    def __init__(self, parameters: StrategyParameters, dims: DimensionKinds) -> None:
        self._horizon = parameters.execution_horizon
        self._k_max = parameters.k_max
        self._window = None if parameters.blend_window == "all" else parameters.blend_window
        self._shape = parameters.blend_shape
        self._dims = dims

    def place(self, timeline: Timeline, arrival: ArrivedChunk, free_step: int) -> Placement:
        return place(arrival, free_step, self._horizon, self._k_max)

    def apply(self, timeline: Timeline, placed: Placement) -> None:
        old, makers = timeline.plan(placed.first)
        rows, weights = overlap_blend(old, placed.rows, self._window, self._dims, self._shape)
        contributions = single_contribution(placed.merged.chunk_id, len(rows))
        for index, weight in enumerate(weights.tolist()):
            contributions[index] = mix_contributions(makers[index], contributions[index], weight)
        timeline.replace(placed.first, rows, contributions)


def query(config: Config) -> Query:
    """Return the part of the strategy that decides when to query."""
    return Paced(config.inference_rate)


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """Return the part of the strategy that merges chunks; `dims` are the dimensions that must not be blended
    linearly.
    """
    return OverlapMerge(config, dims)
