"""A stand-in policy's continuation of the chunk before: a copy. That is RTC's contract, no model of it."""

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
_MODEL_WIDTH = 32
_TRANSITION = 8  # rows over which its own plan takes over


@dataclass(frozen=True, slots=True)
class CommittedPrefix:
    """The robot's commitment: joint rows [L, D], of which the first `delay` will have been executed.

    `end` is the row from which on nothing of it shows, at the latest.
    """

    rows: Float64
    delay: int
    end: int


def continue_prefix(plan: Float32, prefix: CommittedPrefix, switched: Sequence[int] = ()) -> Float32:
    """`plan` [H, D] with the prefix's first rows in place of its own, and over to its own rows after them.

    Dimensions in `switched` (binary grippers) are the plan's own after the delay.
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
    """A model's own space: joints as -1 .. 1 of their range (of a turn where they have none), padded with zeros."""

    def __init__(self, robot: Robot) -> None:
        endless = ~np.isfinite(robot.lower) | ~np.isfinite(robot.upper)
        lower, upper = np.where(endless, -np.pi, robot.lower), np.where(endless, np.pi, robot.upper)
        self._centre, self._half = (upper + lower) / 2, (upper - lower) / 2
        self.width = max(_MODEL_WIDTH, robot.dim)

    @property
    def dim(self) -> int:
        """Numbers of a joint row."""
        return len(self._centre)

    def encode(self, joints: Float32) -> Float32:
        """Model rows [H, width] of joint rows [H, D]."""
        made = np.zeros((len(joints), self.width), np.float32)
        made[:, : joints.shape[1]] = (joints - self._centre) / self._half
        return made

    def joints(self, rows: ArrayLike) -> Float64:
        """Joint rows [H, D] of model rows, or of joint rows, which pass; ValueError for others."""
        given = np.asarray(rows, np.float64)
        dim = len(self._centre)
        if given.ndim != 2 or not len(given) or given.shape[1] not in (dim, self.width):
            raise ValueError(
                f"the chunk before has shape {given.shape}, expected [T, {dim}] or [T, {self.width}]"
            )
        return given if given.shape[1] == dim else given[:, :dim] * self._half + self._centre
