"""Strategy `ensemble`: query during motion, and average all chunks that cover a step (ACT, arXiv 2304.13705)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from runtime.core.types import Float64
from runtime.motion.timeline import Contributions, DimensionKinds, PlacedChunk, Timeline, difference
from runtime.strategies.base import ArrivedChunk, Merge, Paced, Placement, Query, StrategyParameters
from runtime.strategies.placement import place

USES = frozenset({"inference_rate", "k_max", "ensemble_m", "ensemble_horizon"})


class Config(StrategyParameters):
    """Request while moving; each step is the weighted mean of all chunks that cover it, the oldest weighted most."""

    kind: Literal["ensemble"] = "ensemble"


class EnsembleMerge(Merge):
    """Merge in which each step is the weighted mean of all chunks that cover the step.

    The weight is exp(-m * rank), where the oldest chunk has rank 0. Chunks are not cropped, and each row is used at its
    intended step. The timeline stores the chunks that still cover a step, but at most the newest `horizon` chunks; the
    others no longer take part. The mean is computed as the newest chunk plus weighted differences, so that equal chunks
    average to themselves exactly.
    """

    def __init__(self, k_max: int | None, m: float, horizon: int, dims: DimensionKinds) -> None:
        self._k_max = k_max
        self._m = m
        self._horizon = horizon
        self._dims = dims

    def place(self, timeline: Timeline, arrival: ArrivedChunk, free_step: int) -> Placement:
        return place(arrival, free_step, k_max=self._k_max)

    def apply(self, timeline: Timeline, placed: Placement) -> None:
        step = placed.first
        older = (
            PlacedChunk(old.chunk_id, step, old.rows[step - old.first :])
            for old in timeline.laid
            if old.end > step
        )
        laid = (*older, PlacedChunk(placed.merged.chunk_id, step, placed.rows))[-self._horizon :]
        rows: list[Float64] = []
        makers: list[Contributions] = []
        begin = step
        for end in sorted({chunk.end for chunk in laid}):
            covering = [chunk for chunk in laid if chunk.end >= end]
            mean, contributions = self._average(covering, slice(begin - step, end - step))
            rows.append(mean)
            makers.extend([contributions] * (end - begin))
            begin = end
        timeline.replace(step, np.concatenate(rows), makers, laid)

    def _average(self, chunks: Sequence[PlacedChunk], part: slice) -> tuple[Float64, Contributions]:
        """Return the weighted mean of the rows `part` of `chunks` (oldest first), and their contributions."""
        weights = np.exp(-self._m * np.arange(len(chunks)))
        weights /= weights.sum()
        newest = chunks[-1].rows[part]
        mean = newest.copy()
        for chunk, weight in zip(chunks[:-1], weights.tolist(), strict=False):
            mean += weight * difference(chunk.rows[part], newest, self._dims.wrapping)
        switched = list(self._dims.switched)
        mean[:, switched] = newest[:, switched]
        shares = zip(chunks, weights.tolist(), strict=True)
        return mean, tuple((chunk.chunk_id, weight) for chunk, weight in shares)


def query(config: Config) -> Query:
    """Return the part of the strategy that decides when to query."""
    return Paced(config.inference_rate)


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """Return the part of the strategy that merges chunks; `dims` are the dimensions that must not be averaged
    linearly.
    """
    return EnsembleMerge(config.k_max, config.ensemble_m, config.ensemble_horizon, dims)
