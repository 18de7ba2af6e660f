"""Interface of strategies: when to query the policy (coordinator), and how to merge its chunk (control)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from runtime.core.settings import Settings
from runtime.core.types import Float64
from runtime.ipc.messages import MergeResult
from runtime.motion.timeline import (
    HELD,
    Contributions,
    DimensionKinds,
    Fade,
    Timeline,
    fade_weights,
    single_contribution,
    unwrap_onto,
)

BlendShape = Literal["linear", "cosine", "exponential"]
JOIN_WINDOW = 8  # steps of the fade if a chunk does not continue the executed motion
_MOST_SHARES = 4096  # contributions reported per chunk at most: they pass the ring to the coordinator


class StrategyParameters(Settings):
    """Parameters of all strategies; each module's `USES` lists those that affect it."""

    execution_horizon: int | None = Field(default=None, ge=1)
    """Except for ensemble: number of control steps of each chunk that may be executed, counted from its observation;
    absent: all."""
    inference_rate: float | None = Field(default=None, gt=0)
    """Except for sync: requests per second [Hz]; absent: back to back."""
    k_max: int | None = Field(default=None, ge=0)
    """Except for sync: largest number of rows that may be dropped as stale; beyond it the chunk is shifted and recorded
    as mistimed."""
    blend_window: Annotated[int, Field(ge=1)] | Literal["all"] = 8
    """For async and rtc: number of steps over which a new chunk is blended in; "all": the whole overlap."""
    blend_shape: BlendShape = "linear"
    """For async and rtc: decay of the old plan's weight over the window."""
    ensemble_m: float = Field(default=0.01, ge=0)
    """For ensemble: decay m of the weights exp(-m * rank), rank 0 the oldest chunk (ACT, arXiv 2304.13705)."""
    ensemble_horizon: int = Field(default=8, ge=1)
    """For ensemble: largest number of chunks that contribute to one step; the newest are used."""
    delay_quantile: float = Field(default=0.9, gt=0, le=1)
    """For rtc: quantile of recent delays that is the predicted delay of the next response."""


@dataclass(frozen=True, slots=True)
class Progress:
    """State from which a `Query` decides whether to send a request."""

    remaining: int  # steps still planned
    in_flight: bool  # a request is pending, or its chunk is not merged yet
    since_request: float  # [s] since the last request; inf before the first


@dataclass(frozen=True, slots=True)
class ArrivedChunk:
    """Chunk at the control loop: rows [H, D] in command space and at control rate.

    Row 0 is for `observation_step`. If the chunk was `requested_while_stopped`, no row is stale: row 0 is for the first
    free step.
    """

    chunk_id: int
    observation_step: int
    rows: Float64
    requested_while_stopped: bool = False


@dataclass(frozen=True, slots=True)
class Placement:
    """Part of a chunk that is used: `rows` [N, D], of which row 0 is for step `first`.

    `rows` is empty if the chunk is dropped. `before` [D] is the chunk's row that directly precedes `rows`, None if
    there is no such row.
    """

    rows: Float64
    merged: MergeResult
    before: Float64 | None = None

    @property
    def first(self) -> int:
        """Step of row 0."""
        return self.merged.arrival_step


class Query(ABC):
    """Part of a strategy that decides when to query the policy."""

    requests_while_stopped: bool = False  # queries only while the robot stands, so that no row is stale
    uses_rtc: bool = False  # requests carry the committed rows (RTC)

    @abstractmethod
    def should_request(self, progress: Progress) -> bool:
        """Return True if the policy should be queried now."""


class Paced(Query):
    """Query during motion, at a rate [Hz] or (with None) as soon as possible, with at most one pending request."""

    def __init__(self, inference_rate: float | None) -> None:
        self._period = 0.0 if inference_rate is None else 1.0 / inference_rate

    def should_request(self, progress: Progress) -> bool:
        return not progress.in_flight and progress.since_request >= self._period - 1e-6


class Merge(ABC):
    """Part of a strategy that merges chunks; it depends on timeline, chunk and first free step only."""

    requests_while_stopped: bool = False  # an empty timeline is waiting, not starvation
    uses_rtc: bool = False  # reports contributions, because requests continue the chunks (RTC)

    @abstractmethod
    def place(self, timeline: Timeline, arrival: ArrivedChunk, free_step: int) -> Placement:
        """Return the rows to use and their first step, or the reason to drop the chunk; the timeline is not changed."""

    @abstractmethod
    def apply(self, timeline: Timeline, placed: Placement) -> None:
        """Change the plan from `placed.first` on; not called for a dropped chunk."""

    def __call__(self, timeline: Timeline, arrival: ArrivedChunk, free_step: int) -> MergeResult:
        """Merge `arrival` into `timeline` from `free_step` on, without a fade from earlier actions."""
        return join(self, timeline, arrival, free_step, None, DimensionKinds())


def join(
    merge: Merge,
    timeline: Timeline,
    arrival: ArrivedChunk,
    free_step: int,
    held: Float64 | None,
    dims: DimensionKinds,
    *,
    joining: bool = False,
    commanded: Float64 | None = None,
) -> MergeResult:
    """Merge a chunk by its strategy; fade over if it does not continue the motion, so that no strategy causes a jump.

    If the chunk is dropped, nothing is changed. Chunks may be merged while a fade is active: the fade then continues to
    the new plan. The contributions of every step sum to 1; the chunk id HELD in them stands for a held target.

    This function adds a fade only if `held` is given, `joining` is True, or the chunk is mistimed. In all other cases
    the strategy alone decides how the chunk is merged.

    Args:
        merge: The strategy's merge.
        timeline: The timeline to change.
        arrival: The chunk.
        free_step: First step not yet sent.
        held: Target [D] that is held because nothing was planned (starvation, a distant first chunk of a run),
            or None. The chunk takes over from it within JOIN_WINDOW steps, or within its own length if that is
            shorter.
        dims: Dimensions that do not blend linearly.
        joining: True if no chunk has been merged since the kind of strategy was changed. The new plan then
            takes over from the old plan, whose last target is held as long as needed, or from `commanded` if
            nothing is planned. The caller passes True again until a chunk is not dropped.
        commanded: Last target sent [D]; if nothing is planned, wrapping angles continue from it without a whole
            turn.
    """
    placed = merge.place(timeline, arrival, free_step)
    if placed.merged.dropped:
        return placed.merged
    # Mistimed rows are for other steps, so they need not continue the plan.
    joining = joining or placed.merged.mistimed > 0
    planned = timeline.at(free_step)
    standing = commanded if held is None and joining and planned is None else held
    going_on = commanded if planned is None else planned.action
    before = going_on if standing is None else standing
    placed = replace(placed, rows=unwrap_onto(placed.rows, before, dims.wrapping))
    if standing is not None:
        _fade(timeline, free_step, standing[None], [], min(JOIN_WINDOW, len(placed.rows)), dims)
    elif joining and planned is not None:
        _fade(timeline, free_step, *timeline.executed_rows(free_step), JOIN_WINDOW, dims)
    merge.apply(timeline, placed)
    contributions = timeline.executed_rows(free_step)[1]
    shares = _contributions(free_step, contributions, placed.merged.chunk_id) if merge.uses_rtc else None
    return replace(
        placed.merged, overlap=sum(len(makers) > 1 for makers in contributions), contributions=shares
    )


def _contributions(first: int, contributions: Sequence[Contributions], chunk_id: int) -> Float64 | None:
    alone = ((chunk_id, 1.0),)
    entries = [
        (step, maker, weight)
        for step, makers in enumerate(contributions, first)
        if makers != alone
        for maker, weight in makers
    ]
    return np.array(entries, np.float64).reshape(-1, 3) if len(entries) <= _MOST_SHARES else None


def _fade(
    timeline: Timeline,
    step: int,
    rows: Float64,
    makers: list[Contributions],
    count: int,
    dims: DimensionKinds,
) -> None:
    """Start a fade in which the next plan takes over from `rows` within `count` steps.

    If there are fewer rows than steps, the last row is held. `makers` are the contributions of the first rows. Rows
    beyond them are held targets, and their contribution is HELD.
    """
    last = np.minimum(np.arange(count), len(rows) - 1)
    contributions = [*makers[:count], *single_contribution(HELD, max(0, count - len(makers)))]
    timeline.begin_fade(Fade(step, rows[last], tuple(contributions), fade_weights(count), dims))
