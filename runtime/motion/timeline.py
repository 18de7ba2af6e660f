"""Timeline of the actions to be executed, by absolute control step, with the chunks that contributed to each of
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.core.types import Float64

Contributions = tuple[tuple[int, float], ...]  # (chunk id, weight); the weights of a step sum to 1
HELD = 0  # chunk id of a held target
_TURN = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class DimensionKinds:
    """Dimensions that must not be blended linearly."""

    switched: tuple[int, ...] = ()  # binary grippers: follow the new chunk at once
    wrapping: tuple[int, ...] = ()  # angles without limits: blended on the circle


_PLAIN = DimensionKinds()


@dataclass(frozen=True, slots=True)
class Planned:
    """Action planned for one step, float64 [D], with the chunks that contributed to it."""

    action: Float64
    contributions: Contributions


@dataclass(frozen=True, slots=True)
class PlacedChunk:
    """Chunk on the timeline: float64 [N, D]; row 0 is for step `first`."""

    chunk_id: int
    first: int
    rows: Float64

    @property
    def end(self) -> int:
        """First step after the last row."""
        return self.first + len(self.rows)


@dataclass(frozen=True, slots=True)
class Fade:
    """Transition from outgoing actions to the plan, from step `first` on.

    `rows` float64 [L, D] are the outgoing actions, and `contributions` has the contributions of each of them. `weights`
    [L] has the weight of each outgoing action in the blend with the plan.
    """

    first: int
    rows: Float64
    contributions: tuple[Contributions, ...]
    weights: Float64
    dims: DimensionKinds

    def blend(self, step: int, plan: Planned) -> Planned:
        """Return the action of `step`: `plan`, blended with the outgoing action if the fade covers that step."""
        index = step - self.first
        if not 0 <= index < len(self.rows) or not self.weights[index] > 0.0:
            return plan
        weight = float(self.weights[index])
        action = plan.action + weight * difference(self.rows[index], plan.action, self.dims.wrapping)
        switched = list(self.dims.switched)
        action[switched] = plan.action[switched]
        return Planned(action, mix_contributions(self.contributions[index], plan.contributions, weight))


class Timeline:
    """Contiguous planned actions from step `first` on; empty if nothing is planned.

    The executed actions (`at`, `executed_rows`) are the strategy's `plan`, blended with `fade` as long as a fade is
    active. A chunk merged in that time changes the plan, and the fade continues over the new plan. `laid` are the
    chunks on the timeline that a strategy still needs for averaging. A new plan discards all steps before the new
    plan's first step.
    """

    def __init__(self, dim: int) -> None:
        self._dim = dim
        self.clear()

    def clear(self) -> None:
        """Remove the plan, the placed chunks and the fade."""
        self.first = 0
        self.rows: Float64 = np.empty((0, self._dim))
        self.makers: list[Contributions] = []
        self.laid: tuple[PlacedChunk, ...] = ()
        self.fade: Fade | None = None

    def at(self, step: int) -> Planned | None:
        """Return the action to execute at `step` with its contributions; None if nothing is planned."""
        index = step - self.first
        if not 0 <= index < len(self.rows):
            return None
        plan = Planned(self.rows[index], self.makers[index])
        return plan if self.fade is None else self.fade.blend(step, plan)

    def remaining(self, step: int) -> int:
        """Return the number of steps planned from `step` on."""
        return max(0, self.first + len(self.rows) - max(step, self.first))

    def plan(self, step: int) -> tuple[Float64, list[Contributions]]:
        """Return rows [N, D] and contributions of the plan from `step` on, without the fade.

        Both are empty if the plan starts after `step`.
        """
        index = step - self.first
        if index < 0:
            return self.rows[:0], []
        return self.rows[index:], self.makers[index:]

    def executed_rows(self, step: int) -> tuple[Float64, list[Contributions]]:
        """Return rows [N, D] and contributions of the actions to execute from `step` on, including the fade."""
        rows, makers = self.plan(step)
        if self.fade is None:
            return rows, makers
        rows = rows.copy()
        for index in range(min(len(rows), max(0, self.fade.first + len(self.fade.rows) - step))):
            blended = self.fade.blend(step + index, Planned(rows[index], makers[index]))
            rows[index], makers[index] = blended.action, blended.contributions
        return rows, makers

    def replace(
        self, step: int, rows: Float64, makers: Sequence[Contributions], laid: tuple[PlacedChunk, ...] = ()
    ) -> None:
        """Replace the whole plan by `rows` [N, D], which begin at `step`; a fade that has ended by then is removed.

        `makers` are the contributions of each row, `laid` the placed chunks that the strategy still needs.
        """
        self.first = step
        self.rows = np.array(rows, np.float64)
        self.makers = list(makers)
        self.laid = laid
        if self.fade is not None and self.fade.first + len(self.fade.rows) <= step:
            self.fade = None

    def begin_fade(self, fade: Fade) -> None:
        """Discard the plan and start `fade`; the next plan is then blended with the actions in `fade` only."""
        self.clear()
        self.fade = fade


def single_contribution(chunk_id: int, count: int) -> list[Contributions]:
    """Return the contributions of `count` rows, all of which come from the chunk `chunk_id` alone."""
    return [((chunk_id, 1.0),)] * count


def mix_contributions(old: Contributions, new: Contributions, weight: float) -> Contributions:
    """Return the contributions of a step that is blended from `old` with `weight` and `new` with 1 - `weight`."""
    shares: dict[int, float] = {}
    for makers, part in ((old, weight), (new, 1.0 - weight)):
        for maker, share in makers if part > 0.0 else ():
            shares[maker] = shares.get(maker, 0.0) + share * part
    return tuple(shares.items())


def difference(old: Float64, new: Float64, wrapping: Sequence[int] = ()) -> Float64:
    """Return old - new [..., D], for the `wrapping` dimensions along the shorter arc."""
    apart: Float64 = old - new
    if len(wrapping):
        turning = list(wrapping)
        apart[..., turning] -= _TURN * np.round(apart[..., turning] / _TURN)
    return apart


def unwrap_onto(rows: Float64, before: Float64 | None, wrapping: Sequence[int]) -> Float64:
    """Return `rows` [N, D] with continuous wrapping angles that start within half a turn of `before` [D]."""
    if not len(wrapping) or not len(rows):
        return rows
    turning = list(wrapping)
    continuous = rows.copy()
    continuous[:, turning] = np.unwrap(rows[:, turning], axis=0)
    if before is not None:
        continuous[:, turning] += _TURN * np.round((before[turning] - rows[0, turning]) / _TURN)
    return continuous


def fade_weights(count: int, shape: str = "linear") -> Float64:
    """Return the weights [count] of the outgoing plan: 1 at the first row, 0 at the last; 0 for a single row.

    The allowed shapes are:

    * "linear": the weight falls evenly.
    * "cosine": the weight has no kink at either end.
    * "exponential": the weight is c (e^c - 1) / (e - 1), where c is the linear weight. This is the soft mask of
      real-time chunking (arXiv 2506.07339, eq. 5). With this shape the new plan takes over sooner.

    Raises:
        ValueError: If `shape` is unknown.
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
    """Blend the first rows of `new` with `old`; return the blended rows [N, D] and the weights [L] of `old`.

    `old` [M, D] and `new` [N, D] start at the same step. L = min(M, N, `window`) rows are blended with the weights of
    `fade_weights`; if `window` is None, the whole overlap. Binary grippers have the new value at once. The result is
    computed as new + w (old - new), so that equal inputs stay exactly equal.
    """
    weights = fade_weights(min(len(old), len(new), len(new) if window is None else window), shape)
    blended, count, switched = new.copy(), len(weights), list(dims.switched)
    blended[:count] += weights[:, None] * difference(old[:count], new[:count], dims.wrapping)
    blended[:, switched] = new[:, switched]
    return blended, weights
