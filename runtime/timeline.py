"""What is to be executed, by absolute control step, and which chunks made each step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.types import Float64

Makers = tuple[tuple[int, float], ...]  # (chunk id, weight), the weights of a step sum to 1


@dataclass(frozen=True, slots=True)
class Dims:
    """Dimensions that do not blend as numbers do."""

    switched: tuple[int, ...] = ()  # binary grippers: they switch where the new chunk switches
    wrapping: tuple[int, ...] = ()  # angles without limits: blended on the circle


@dataclass(frozen=True, slots=True)
class Planned:
    """The action meant for one step: float64 [D], and the chunks it was made from."""

    action: Float64
    makers: Makers


class Timeline:
    """A contiguous run of planned actions from `first` on; empty where nothing is planned."""

    def __init__(self, dim: int) -> None:
        self._dim = dim
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.first = 0
        self.rows: Float64 = np.empty((0, self._dim))
        self.makers: list[Makers] = []

    def at(self, step: int) -> Planned | None:
        """What is planned for `step`; None where nothing is."""
        index = step - self.first
        if 0 <= index < len(self.rows):
            return Planned(self.rows[index], self.makers[index])
        return None

    def remaining(self, step: int) -> int:
        """How many steps are planned from `step` on."""
        return max(0, self.first + len(self.rows) - max(step, self.first))

    def span(self, step: int) -> tuple[Float64, list[Makers]]:
        """Everything planned from `step` on: rows [N, D] and their makers; nothing if the plan starts later."""
        index = step - self.first
        if index < 0:
            return self.rows[:0], []
        return self.rows[index:], self.makers[index:]

    def replace(self, step: int, rows: Float64, makers: Sequence[Makers]) -> None:
        """Let `rows` be the whole plan from `step` on; what was planned before `step` is over."""
        self.first = step
        self.rows = np.array(rows, np.float64)
        self.makers = list(makers)


def overlap_blend(
    old: Float64, new: Float64, window: int | None, switched: Sequence[int] = ()
) -> tuple[Float64, Float64]:
    """`new` with its first rows blended over from `old`, and the weight of `old` in each blended row.

    `old` [M, D] and `new` [N, D] start at the same step. L = min(M, N, window) rows are blended with
    w_i = 1 - i / (L - 1), w = 0 for L = 1; `window` None is the whole overlap. Dimensions in `switched` (binary
    grippers) take the new value at once. Written as new + w (old - new), so that equal inputs stay equal.
    """
    overlap = min(len(old), len(new), len(new) if window is None else window)
    blended = new.copy()
    if overlap < 2:
        return blended, np.zeros(overlap)
    weights = 1.0 - np.arange(overlap) / (overlap - 1)
    blended[:overlap] += weights[:, None] * (old[:overlap] - new[:overlap])
    blended[:, list(switched)] = new[:, list(switched)]
    return blended, weights


def resample(
    rows: Float64, rate: float, control_rate: float, switched: Sequence[int] = ()
) -> tuple[Float64, np.ndarray]:
    """`rows` [H, D] of `rate` Hz at `control_rate` Hz, and the source row each one came from.

    Linear between rows, the last row held for its own period; dimensions in `switched` are held, not blended.
    """
    if rate == control_rate or not len(rows):
        return rows, np.arange(len(rows))
    count = int(np.floor(len(rows) * control_rate / rate + 1e-9))
    position = np.minimum(np.arange(count) * (rate / control_rate), len(rows) - 1)
    lower = np.floor(position + 1e-9).astype(np.int64)
    upper = np.minimum(lower + 1, len(rows) - 1)
    part = np.clip(position - lower, 0.0, 1.0)[:, None]
    resampled = rows[lower] + part * (rows[upper] - rows[lower])
    resampled[:, list(switched)] = rows[lower][:, list(switched)]
    return resampled, lower
