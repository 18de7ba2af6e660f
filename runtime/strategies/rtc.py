"""`rtc`: ask while moving, telling the policy what the robot is committed to, so that the answer continues it.

Real-time chunking (arXiv 2506.07339). The conditioning is made by whoever asks; what is left of a seam, because
the delay was not the predicted one or the policy did not keep to the prefix, passes the overlap blend of `async`.
"""

from __future__ import annotations

from typing import Literal

from runtime.strategies.base import Merge, Paced, Query, StrategyParameters
from runtime.strategies.overlap import OverlapMerge
from runtime.timeline import Dims

USES = frozenset(
    {"execution_horizon", "inference_rate", "k_max", "blend_window", "blend_shape", "delay_quantile"}
)


class Config(StrategyParameters):
    """Ask while moving; the policy is told what the robot is committed to and continues it."""

    kind: Literal["rtc"] = "rtc"


class RtcQuery(Paced):
    """Asks back to back, or at a rate; its requests carry what the robot is committed to."""

    continues = True


def query(config: Config) -> Query:
    """The asking half."""
    return RtcQuery(config.inference_rate)


def merge(config: Config, dims: Dims) -> Merge:
    """The merging half; `dims` says what does not blend as numbers do."""
    return OverlapMerge(config, dims)
