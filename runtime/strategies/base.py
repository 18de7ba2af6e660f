"""A strategy has two halves: when to ask the policy (coordinator), how an answer joins the timeline (control)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from runtime.core.settings import Settings
from runtime.core.types import Float64
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
JOIN_WINDOW = 8  # steps over which a chunk takes over from what it does not continue
_MOST_SHARES = 4096  # that are told of a chunk: they pass the ring to the coordinator


class StrategyParameters(Settings):
    """The one set of parameters of all strategies; each module's `USES` names those that mean something to it."""

    execution_horizon: int | None = Field(default=None, ge=1)
    """Control steps of each chunk that may be executed, counted from its observation; all where it is not given."""
    inference_rate: float | None = Field(default=None, gt=0)
    """Requests per second [Hz]; back to back where it is not given."""
    k_max: int | None = Field(default=None, ge=0)
    """Most rows that may be dropped as stale; beyond it the chunk is shifted and recorded as mistimed."""
    blend_window: Annotated[int, Field(ge=1)] | Literal["all"] = 8
    """Steps over which a new chunk is blended in; "all" is the whole overlap."""
    blend_shape: BlendShape = "linear"
    """How the old plan's weight falls over the window."""
    ensemble_m: float = Field(default=0.01, ge=0)
    """Decay of the weights exp(-m * rank), rank 0 the oldest chunk (ACT, arXiv 2304.13705)."""
    ensemble_horizon: int = Field(default=8, ge=1)
    """Most chunks that make one step; the newest are kept."""
    delay_quantile: float = Field(default=0.9, gt=0, le=1)
    """Quantile of recent delays that is predicted for the next answer."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Facts that the asking half may decide by."""

    remaining: int  # steps still planned
    in_flight: bool  # a request is out, or its answer has not been merged yet
    since_request: float  # [s] since the last request was sent; inf before the first


@dataclass(frozen=True, slots=True)
class ArrivedChunk:
    """A chunk at the control loop: rows [H, D] in command space and control rate.

    Row 0 is for `observation_step`; where it `waited` nothing of it is stale, and row 0 is for the first free step.
    """

    chunk_id: int
    observation_step: int
    rows: Float64
    requested_while_stopped: bool = False


@dataclass(frozen=True, slots=True)
class MergeResult:
    """Place of a chunk on the timeline.

    `arrival_step` is the first tick not yet sent, `delay` = arrival_step - observation_step. `targets` int64 [H]
    is the step each row was planned for, -1 where it was dropped. `mistimed` is how many steps later than meant
    its rows are executed (k_max); negative where it arrived before the step it is for. `dropped` says why nothing
    of the chunk was used, "" where something was. `shares` [N, 3] are step, chunk id and weight of what makes steps
    that are not the chunk's alone; None where `Merge.continues` is false, or there are too many.
    """

    chunk_id: int
    arrival_step: int
    delay: int
    targets: NDArray[np.int64]
    mistimed: int = 0
    dropped: str = ""
    overlap: int = (
        0  # steps from arrival_step on that more than one chunk makes, or a chunk and a held target
    )
    contributions: Float64 | None = None


@dataclass(frozen=True, slots=True)
class Placement:
    """Which rows of a chunk are used: [N, D], row 0 for step `merged.arrival_step`; none where it is dropped.

    `before` [D] is the row before them, None where there is none.
    """

    rows: Float64
    merged: MergeResult
    before: Float64 | None = None

    @property
    def first(self) -> int:
        """The step of row 0."""
        return self.merged.arrival_step


class Query(ABC):
    """Decides when the policy is asked."""

    requests_while_stopped: bool = (
        False  # it asks while the robot stands, so that nothing of the answer is stale
    )
    uses_rtc: bool = False  # its requests carry what the robot is committed to (RTC)

    @abstractmethod
    def should_request(self, progress: Progress) -> bool:
        """True if the policy is to be asked now."""


class Paced(Query):
    """Asks while the robot moves: back to back, or at a rate [Hz], never with a request in flight."""

    def __init__(self, inference_rate: float | None) -> None:
        self._period = 0.0 if inference_rate is None else 1.0 / inference_rate

    def should_request(self, progress: Progress) -> bool:
        return not progress.in_flight and progress.since_request >= self._period - 1e-6


class Merge(ABC):
    """Lets a chunk join the timeline; a pure function of timeline, chunk and first free step."""

    requests_while_stopped: bool = (
        False  # an empty timeline is this strategy's way of waiting, not starvation
    )
    uses_rtc: bool = False  # its chunks are continued (RTC): what makes each step is told

    @abstractmethod
    def place(self, timeline: Timeline, arrival: ArrivedChunk, free_step: int) -> Placement:
        """Which rows fall on which steps, or why none does; changes nothing."""

    @abstractmethod
    def apply(self, timeline: Timeline, placed: Placement) -> None:
        """Change what is planned from `placed.first` on; never called for a chunk that is dropped."""

    def __call__(self, timeline: Timeline, arrival: ArrivedChunk, free_step: int) -> MergeResult:
        """Change `timeline` from `free_step` on and say where the rows went; nothing is joined to."""
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
    """Merge a chunk; where it does not continue what came before it, fade over from that: no strategy may jump.

    `held` [D] is the target that is held because nothing was planned (starvation, a run's far first chunk): the
    chunk takes over from it within JOIN_WINDOW steps, or its own length if it is shorter. `joining` says that the
    strategy's kind was switched since the last chunk that was merged: the new plan takes over from the old one,
    whose last target is held as long as needed, or from `commanded` where nothing is planned; keep it set until a
    chunk is not dropped. Where neither is given the strategy alone decides. Chunks may be merged while a fade is
    under way: it goes on over their plan. `commanded` [D] is the last target sent: angles that wrap stay on its
    branch where nothing is planned. Nothing is changed where the chunk is dropped. The makers of every step sum
    to 1; chunk id 0 (timeline.HELD) is a held target.
    """
    placed = merge.place(timeline, arrival, free_step)
    if placed.merged.dropped:
        return placed.merged
    joining = (
        joining or placed.merged.mistimed > 0
    )  # its rows are for other steps: nothing says that they continue
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
    made = timeline.executed_rows(free_step)[1]
    shares = _contributions(free_step, made, placed.merged.chunk_id) if merge.uses_rtc else None
    return replace(placed.merged, overlap=sum(len(makers) > 1 for makers in made), contributions=shares)


def _contributions(first: int, made: Sequence[Contributions], chunk_id: int) -> Float64 | None:
    alone = ((chunk_id, 1.0),)
    told = [
        (step, maker, weight)
        for step, makers in enumerate(made, first)
        if makers != alone
        for maker, weight in makers
    ]
    return np.array(told, np.float64).reshape(-1, 3) if len(told) <= _MOST_SHARES else None


def _fade(
    timeline: Timeline,
    step: int,
    rows: Float64,
    makers: list[Contributions],
    count: int,
    dims: DimensionKinds,
) -> None:
    """Let what is planned next take over from `rows` within `count` steps; the last row is held where they end.

    Rows beyond `makers` are held targets.
    """
    last = np.minimum(np.arange(count), len(rows) - 1)
    made = [*makers[:count], *single_contribution(HELD, max(0, count - len(makers)))]
    timeline.begin_fade(Fade(step, rows[last], tuple(made), fade_weights(count), dims))
