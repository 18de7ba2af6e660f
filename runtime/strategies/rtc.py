"""`rtc`: ask while moving, telling the policy what the robot is committed to, so that the answer continues it.

Real-time chunking (arXiv 2506.07339). The conditioning is made by whoever asks. An answer that continues what is
executed is laid as it is; a seam, because the answer came later than predicted or the policy did not keep to the
prefix, passes the overlap blend of `async`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from runtime.motion.timeline import DimensionKinds, Timeline, difference, single_contribution
from runtime.strategies.base import Merge, Paced, Placement, Query, StrategyParameters
from runtime.strategies.overlap import OverlapMerge

_CONTINUED = 1e-3  # [rad] that a model's arithmetic and inverse kinematics may be off by
USES = frozenset(
    {"execution_horizon", "inference_rate", "k_max", "blend_window", "blend_shape", "delay_quantile"}
)


class Config(StrategyParameters):
    """Ask while moving; the policy is told what the robot is committed to and continues it."""

    kind: Literal["rtc"] = "rtc"


class RtcQuery(Paced):
    """Asks back to back, or at a rate; its requests carry what the robot is committed to."""

    uses_rtc = True


class RtcMerge(OverlapMerge):
    """Lays a chunk as it is where it passes through the step that is executed last before it, else blended."""

    uses_rtc = True

    def apply(self, timeline: Timeline, placed: Placement) -> None:
        if not self._continues(timeline, placed):
            super().apply(timeline, placed)
            return
        timeline.fade = None  # the chunk continues what was made of it
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
    """The asking half."""
    return RtcQuery(config.inference_rate)


def merge(config: Config, dims: DimensionKinds) -> Merge:
    """The merging half; `dims` says what does not blend as numbers do."""
    return RtcMerge(config, dims)
