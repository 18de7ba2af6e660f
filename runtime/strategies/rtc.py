"""Strategy `rtc`: query during motion, with the committed rows in the request, so that the chunk continues them.

Real-time chunking (arXiv 2506.07339). The requester builds the conditioning. A chunk that continues the executed
actions replaces the plan as it is. Otherwise (it arrived later than predicted, or the policy ignored the prefix) it is
blended as in `async`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from runtime.motion.timeline import DimensionKinds, Timeline, difference, single_contribution
from runtime.strategies.base import Merge, Paced, Placement, Query, StrategyParameters
from runtime.strategies.overlap import OverlapMerge

_CONTINUED = 1e-3  # [rad] tolerance for the arithmetic of a model and of IK
USES = frozenset(
    {"execution_horizon", "inference_rate", "k_max", "blend_window", "blend_shape", "delay_quantile"}
)


class Config(StrategyParameters):
    """Request while moving; the policy receives the committed actions and continues them."""

    kind: Literal["rtc"] = "rtc"


class RtcQuery(Paced):
    """Query during motion, at a rate or as soon as possible; requests carry the committed rows."""

    uses_rtc = True


class RtcMerge(OverlapMerge):
    """Merge that uses a chunk unchanged if the chunk continues the executed actions; otherwise it blends the chunk.

    A chunk continues them if its row for the step executed last is the action that was executed in that step.
    """

    uses_rtc = True

    def apply(self, timeline: Timeline, placed: Placement) -> None:
        if not self._continues(timeline, placed):
            super().apply(timeline, placed)
            return
        timeline.fade = None  # a chunk that continues the blended actions needs no further fade
        timeline.replace(
            placed.first, placed.rows, single_contribution(placed.merged.chunk_id, len(placed.rows))
        )

    def _continues(self, timeline: Timeline, placed: Placement) -> bool:
        last = timeline.at(placed.first - 1)
        if last is None or placed.before is None:
            return False
        apart = difference(placed.before, last.action, self._dims.wrapping)
        apart[list(self._dims.switched)] = 0.0
        return bool(np.abs(apart).max() <= _CONTINUED)


def query(config: Config) -> Query:
    """Return the part of the strategy that decides when to query."""
    return RtcQuery(config.inference_rate)


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """Return the part of the strategy that merges chunks; `dims` are the dimensions that must not be blended
    linearly.
    """
    return RtcMerge(config, dims)
