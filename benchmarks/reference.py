"""Policies whose every action is known beforehand: they answer with rows of a trajectory, by control step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from runtime.core.types import Conditioning, Float64
from runtime.motion.timeline import overlap_blend

DIM = 3
DISAGREEMENT = 0.02  # [rad] that a chunk may be off as a whole
_WAVES = ((0.4, 0.3), (0.2, 0.7), (0.1, 1.1))  # amplitude [rad], frequency [Hz]: up to 2.3 rad/s
_PHASES = 2.0 * np.pi * np.arange(DIM) / DIM
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
_SEAM = 8  # rows within which the stand-in of a real-time chunking model goes over to what it means now

IntendedRows = Callable[[int], Float64]  # observation step -> rows [H, DIM]


@dataclass(frozen=True, slots=True)
class Reference:
    """Three joints on sums of sines; `rate` [Hz] is the control rate, steps may be fractions."""

    rate: float

    def at(self, steps: Float64) -> Float64:
        """Positions [N, DIM] at `steps` [N]."""
        return self._waves(steps, 0)

    def slope(self, steps: Float64) -> Float64:
        """Their change per step [N, DIM]."""
        return self._waves(steps, 1)

    def _waves(self, steps: Float64, order: int) -> Float64:
        turn = 2.0 * np.pi / self.rate
        made = np.zeros((len(steps), DIM))
        for amplitude, frequency in _WAVES:
            angle = turn * frequency * np.asarray(steps)[:, None] + frequency * 7.0 + _PHASES
            made += amplitude * (np.cos(angle) * turn * frequency if order else np.sin(angle))
        return made


def chunks_of(table: Float64, horizon: int) -> IntendedRows:
    """Rows of `table` [N, DIM], from the observation step on."""
    return lambda step: table[step : step + horizon]


def with_disagreement(meant: IntendedRows) -> IntendedRows:
    """The same, each chunk off by a constant of its own of at most DISAGREEMENT: nothing random, no two alike."""

    def rows(step: int) -> Float64:
        part = (np.arange(1, DIM + 1) * (step + 1) * _GOLDEN) % 1.0
        return meant(step) + DISAGREEMENT * (2.0 * part - 1.0)

    return rows


def make_policy(meant: IntendedRows) -> Callable[[int, Conditioning | None], Float64]:
    """A policy that means `meant`, and continues its last chunk where it is told what the robot is committed to.

    A stand-in for a model with real-time chunking: the rows that will have been executed when the answer arrives
    are repeated, then it goes over to what it means now within 8 rows. It is no evidence for any model.
    """

    def policy(step: int, conditioning: Conditioning | None) -> Float64:
        rows = meant(step)
        if conditioning is None:
            return rows
        left = conditioning.remaining_rows.astype(np.float64)[: len(rows)]
        kept = min(conditioning.predicted_delay, len(left))
        after, _ = overlap_blend(left[kept:], rows[kept:], _SEAM)
        return np.concatenate([left[:kept], after])

    return policy
