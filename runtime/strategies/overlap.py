"""`async`: ask while moving, blend the new chunk over the rest of the old one.

The linear overlap blend over the whole overlap ("all") is the published scheme of asynchronous chunk execution;
the default window is shorter because "all" takes over 30 steps to follow a change of mind.
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
from runtime.strategies.placing import place

USES = frozenset({"execution_horizon", "inference_rate", "k_max", "blend_window", "blend_shape"})


class Config(StrategyParameters):
    """Ask while moving; a new chunk is blended over from the rest of the old one."""

    kind: Literal["async"] = "async"


class OverlapMerge(Merge):
    """Drops what is stale, puts every row on the step it was meant for, blends over the overlap."""

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
        made = single_contribution(placed.merged.chunk_id, len(rows))
        for index, weight in enumerate(weights.tolist()):
            made[index] = mix_contributions(makers[index], made[index], weight)
        timeline.replace(placed.first, rows, made)


def query(config: Config) -> Query:
    """The asking half."""
    return Paced(config.inference_rate)


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """The merging half; `dims` says what does not blend as numbers do."""
    return OverlapMerge(config, dims)
