"""Policies whose every action is known: row by row, their actions are those of a trajectory at the control step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from runtime.core.types import Conditioning, Float64
from runtime.motion.timeline import overlap_blend

DIM = 3
DISAGREEMENT = 0.02  # [rad] offset of a chunk
_WAVES = ((0.4, 0.3), (0.2, 0.7), (0.1, 1.1))  # amplitude [rad], frequency [Hz]: up to 2.3 rad/s
_PHASES = 2.0 * np.pi * np.arange(DIM) / DIM
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
_SEAM = 8  # rows of the transition to new intentions in the stand-in of a real-time chunking model

IntendedRows = Callable[[int], Float64]  # observation step -> rows [H, DIM]


@dataclass(frozen=True, slots=True)
class Reference:
    """Trajectory of three joints as sums of sines; `rate` [Hz] is the control rate, and steps may be fractional."""

    rate: float

    def at(self, steps: Float64) -> Float64:
        """Return the positions [N, DIM] at `steps` [N]."""
        return self._waves(steps, 0)

    def slope(self, steps: Float64) -> Float64:
        """Return the changes per step [N, DIM]."""
        return self._waves(steps, 1)

    def _waves(self, steps: Float64, order: int) -> Float64:
        turn = 2.0 * np.pi / self.rate
        waves = np.zeros((len(steps), DIM))
        for amplitude, frequency in _WAVES:
            angle = turn * frequency * np.asarray(steps)[:, None] + frequency * 7.0 + _PHASES
            waves += amplitude * (np.cos(angle) * turn * frequency if order else np.sin(angle))
        return waves


def chunks_of(table: Float64, horizon: int) -> IntendedRows:
    """Return a function that returns `horizon` rows of `table` [N, DIM] from the observation's step on."""
    return lambda step: table[step : step + horizon]


def with_disagreement(meant: IntendedRows) -> IntendedRows:
    """Return `meant`, changed so that each chunk has a constant offset of at most DISAGREEMENT.

    The offset is deterministic and different for each chunk.
    """

    def rows(step: int) -> Float64:
        part = (np.arange(1, DIM + 1) * (step + 1) * _GOLDEN) % 1.0
        return meant(step) + DISAGREEMENT * (2.0 * part - 1.0)

    return rows


def make_policy(meant: IntendedRows) -> Callable[[int, Conditioning | None], Float64]:
    """Return a policy with the rows of `meant` that continues its last chunk if the request is conditioned.

    The policy stands in for a model with real-time chunking: it repeats the rows that will have been executed before
    its answer arrives, then changes to its current intention within 8 rows. Results with it show nothing about real
    models.
    """

    def policy(step: int, conditioning: Conditioning | None) -> Float64:
        rows = meant(step)
        if conditioning is None:
            return rows
        left = conditioning.remaining_rows.astype(np.float64)[: len(rows)]
        prefix_length = min(conditioning.predicted_delay, len(left))
        after, _ = overlap_blend(left[prefix_length:], rows[prefix_length:], _SEAM)
        return np.concatenate([left[:prefix_length], after])

    return policy
