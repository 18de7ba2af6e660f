"""Continuation of the previous chunk by a stand-in policy, which copies the prefix as RTC requires.

It does not show how well a model continues chunks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from runtime.core.types import Float32, Float64

if TYPE_CHECKING:
    from robots import Robot

STAND_IN = "honours the prefix by copying it; no evidence for a model"
_MODEL_WIDTH = 32  # least numbers per row of the model
_TRANSITION = 8  # rows of the transition from the prefix to the plan


@dataclass(frozen=True, slots=True)
class CommittedPrefix:
    """Joint rows [L, D] of a request that the robot is committed to.

    The first `delay` rows will have been executed when the chunk arrives. From row `end` on, the chunk is independent
    of the prefix.
    """

    rows: Float64
    delay: int
    end: int


def continue_prefix(plan: Float32, prefix: CommittedPrefix, switched: Sequence[int] = ()) -> Float32:
    """Return `plan` [H, D] with its start replaced by the first `delay` rows of the prefix and a transition to `plan`.

    Dimensions in `switched` (binary grippers) follow `plan` from row `delay` on, without a transition.
    """
    delay = min(prefix.delay, len(prefix.rows), len(plan))
    end = max(delay, min(prefix.end, delay + _TRANSITION, len(prefix.rows), len(plan)))
    weights = 1.0 - np.arange(1, end - delay + 1) / (end - delay + 1)
    rows = plan.astype(np.float64)
    rows[:delay] = prefix.rows[:delay]
    rows[delay:end] += weights[:, None] * (prefix.rows[delay:end] - rows[delay:end])
    rows[delay:end, list(switched)] = plan[delay:end, list(switched)]
    return rows.astype(np.float32)


class ModelSpace:
    """Space of a model's rows: joints scaled to -1 .. 1 of their range, padded with zeros.

    The range of a joint without limits is one turn.
    """

    def __init__(self, robot: Robot) -> None:
        endless = ~np.isfinite(robot.lower) | ~np.isfinite(robot.upper)
        lower, upper = np.where(endless, -np.pi, robot.lower), np.where(endless, np.pi, robot.upper)
        self._centre, self._half = (upper + lower) / 2, (upper - lower) / 2
        self.width = max(_MODEL_WIDTH, robot.dim)

    @property
    def dim(self) -> int:
        """Number of joints in a row."""
        return len(self._centre)

    def encode(self, joints: Float32) -> Float32:
        """Convert joint rows [H, D] to model rows [H, width]."""
        encoded = np.zeros((len(joints), self.width), np.float32)
        encoded[:, : joints.shape[1]] = (joints - self._centre) / self._half
        return encoded

    def joints(self, rows: ArrayLike) -> Float64:
        """Convert model rows to joint rows [H, D]; rows as wide as the joints are returned unchanged.

        Raises:
            ValueError: If the rows have another width, or there are none.
        """
        chunk = np.asarray(rows, np.float64)
        dim = len(self._centre)
        if chunk.ndim != 2 or not len(chunk) or chunk.shape[1] not in (dim, self.width):
            raise ValueError(
                f"the chunk before has shape {chunk.shape}, expected [T, {dim}] or [T, {self.width}]"
            )
        return chunk if chunk.shape[1] == dim else chunk[:, :dim] * self._half + self._centre
