"""Timeline of what is to be executed, by absolute control step, and which chunks made each step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.core.types import Float64

Contributions = tuple[tuple[int, float], ...]  # (chunk id, weight), the weights of a step sum to 1
HELD = 0  # the chunk id of a held target
_TURN = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class DimensionKinds:
    """Dimensions that do not blend as numbers do."""

    switched: tuple[int, ...] = ()  # binary grippers: they switch where the new chunk switches
    wrapping: tuple[int, ...] = ()  # angles without limits: blended on the circle


_PLAIN = DimensionKinds()


@dataclass(frozen=True, slots=True)
class Planned:
    """The action meant for one step: float64 [D], and the chunks it was made from."""

    action: Float64
    contributions: Contributions


@dataclass(frozen=True, slots=True)
class PlacedChunk:
    """A chunk as it was placed: float64 [N, D], row 0 for step `first`."""

    chunk_id: int
    first: int
    rows: Float64

    @property
    def end(self) -> int:
        """The first step after its last row."""
        return self.first + len(self.rows)


@dataclass(frozen=True, slots=True)
class Fade:
    """Actions from `first` on that the plan is blended over from: [L, D], their makers, their weights [L]."""

    first: int
    rows: Float64
    contributions: tuple[Contributions, ...]
    weights: Float64
    dims: DimensionKinds

    def blend(self, step: int, plan: Planned) -> Planned:
        """`plan` for `step`, as far as it has taken over by then."""
        index = step - self.first
        if not 0 <= index < len(self.rows) or not self.weights[index] > 0.0:
            return plan
        weight = float(self.weights[index])
        action = plan.action + weight * difference(self.rows[index], plan.action, self.dims.wrapping)
        switched = list(self.dims.switched)
        action[switched] = plan.action[switched]
        return Planned(action, mix_contributions(self.contributions[index], plan.contributions, weight))


class Timeline:
    """A contiguous run of planned actions from `first` on; empty where nothing is planned.

    What is executed (`at`, `span`) is the strategy's own `plan` with a `fade` over it while one is under way: a
    chunk that is merged meanwhile changes the plan, and the fade goes on. `laid` are the chunks that a strategy
    which averages them still needs. Nothing of the past is kept once a chunk has been merged.
    """

    def __init__(self, dim: int) -> None:
        self._dim = dim
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.first = 0
        self.rows: Float64 = np.empty((0, self._dim))
        self.makers: list[Contributions] = []
        self.laid: tuple[PlacedChunk, ...] = ()
        self.fade: Fade | None = None

    def at(self, step: int) -> Planned | None:
        """Action to be executed at `step`, with its makers; None where nothing is planned."""
        index = step - self.first
        if not 0 <= index < len(self.rows):
            return None
        plan = Planned(self.rows[index], self.makers[index])
        return plan if self.fade is None else self.fade.blend(step, plan)

    def remaining(self, step: int) -> int:
        """Number of steps planned from `step` on."""
        return max(0, self.first + len(self.rows) - max(step, self.first))

    def plan(self, step: int) -> tuple[Float64, list[Contributions]]:
        """The strategy's plan from `step` on: rows [N, D] and makers; nothing if the plan starts later."""
        index = step - self.first
        if index < 0:
            return self.rows[:0], []
        return self.rows[index:], self.makers[index:]

    def executed_rows(self, step: int) -> tuple[Float64, list[Contributions]]:
        """Actions to be executed from `step` on: rows [N, D] and their makers."""
        rows, makers = self.plan(step)
        if self.fade is None:
            return rows, makers
        rows = rows.copy()
        for index in range(min(len(rows), max(0, self.fade.first + len(self.fade.rows) - step))):
            shown = self.fade.blend(step + index, Planned(rows[index], makers[index]))
            rows[index], makers[index] = shown.action, shown.contributions
        return rows, makers

    def replace(
        self, step: int, rows: Float64, makers: Sequence[Contributions], laid: tuple[PlacedChunk, ...] = ()
    ) -> None:
        """Let `rows` be the whole plan from `step` on; what was planned before `step` is over."""
        self.first = step
        self.rows = np.array(rows, np.float64)
        self.makers = list(makers)
        self.laid = laid
        if self.fade is not None and self.fade.first + len(self.fade.rows) <= step:
            self.fade = None

    def begin_fade(self, fade: Fade) -> None:
        """Plan nothing, and let what is planned next be blended over from `fade`, and from nothing else."""
        self.clear()
        self.fade = fade


def single_contribution(chunk_id: int, count: int) -> list[Contributions]:
    """The makers of `count` rows that come from one chunk alone."""
    return [((chunk_id, 1.0),)] * count


def mix_contributions(old: Contributions, new: Contributions, weight: float) -> Contributions:
    """The makers of one step that is `weight` of `old` and the rest of `new`."""
    shares: dict[int, float] = {}
    for makers, part in ((old, weight), (new, 1.0 - weight)):
        for maker, share in makers if part > 0.0 else ():
            shares[maker] = shares.get(maker, 0.0) + share * part
    return tuple(shares.items())


def difference(old: Float64, new: Float64, wrapping: Sequence[int] = ()) -> Float64:
    """old - new [..., D], in dimensions that wrap the shorter way round."""
    apart: Float64 = old - new
    if len(wrapping):
        turning = list(wrapping)
        apart[..., turning] -= _TURN * np.round(apart[..., turning] / _TURN)
    return apart


def unwrap_onto(rows: Float64, before: Float64 | None, wrapping: Sequence[int]) -> Float64:
    """`rows` [N, D] with angles that wrap made continuous, and starting within half a turn of `before` [D]."""
    if not len(wrapping) or not len(rows):
        return rows
    turning = list(wrapping)
    continuous = rows.copy()
    continuous[:, turning] = np.unwrap(rows[:, turning], axis=0)
    if before is not None:
        continuous[:, turning] += _TURN * np.round((before[turning] - rows[0, turning]) / _TURN)
    return continuous


def fade_weights(count: int, shape: str = "linear") -> Float64:
    """Weights [count] of what is blended over from: 1 at the first row, 0 at the last; of one row 0.

    "linear", "cosine" (no kink at either end), or "exponential": c (e^c - 1) / (e - 1) of the linear weight c,
    the soft mask of real-time chunking (arXiv 2506.07339, eq. 5), which goes over sooner.
    """
    if count < 2:
        return np.zeros(count)
    linear = 1.0 - np.arange(count) / (count - 1)
    if shape == "linear":
        return linear
    if shape == "cosine":
        return np.asarray(0.5 - 0.5 * np.cos(np.pi * linear))
    if shape == "exponential":
        return np.asarray(linear * np.expm1(linear) / np.expm1(1.0))
    raise ValueError(f"no blend shape {shape!r}; allowed: linear, cosine, exponential")


def overlap_blend(
    old: Float64, new: Float64, window: int | None, dims: DimensionKinds = _PLAIN, shape: str = "linear"
) -> tuple[Float64, Float64]:
    """`new` with its first rows blended over from `old`, and the weight of `old` in each blended row.

    `old` [M, D] and `new` [N, D] start at the same step. L = min(M, N, window) rows are blended with the weights
    of `fade_weights`; `window` None is the whole overlap. Binary grippers take the new value at once. Written as
    new + w (old - new), so that equal inputs stay equal.
    """
    weights = fade_weights(min(len(old), len(new), len(new) if window is None else window), shape)
    blended, count, switched = new.copy(), len(weights), list(dims.switched)
    blended[:count] += weights[:, None] * difference(old[:count], new[:count], dims.wrapping)
    blended[:, switched] = new[:, switched]
    return blended, weights
