"""A strategy has two halves: when to ask the policy (main), and how an answer joins the timeline (control)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from runtime.section import Section
from runtime.timeline import Makers, Timeline
from runtime.types import Float64

BlendShape = Literal["linear", "cosine", "exponential"]


class StrategyParameters(Section):
    """The one set of parameters of all strategies; each module's `USES` names those that mean something to it."""

    execution_horizon: int | None = Field(default=None, ge=1)
    """Rows of each chunk that may be executed, counted from its observation; all of them where it is not given."""
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
    """What the asking half may decide by."""

    remaining: int  # steps still planned
    in_flight: bool  # a request is out, or its answer has not been merged yet
    since_request: float  # [s] since the last request was sent; inf before the first


@dataclass(frozen=True, slots=True)
class Arrival:
    """A chunk at the control loop: rows [H, D] in command space and control rate.

    Row 0 is for `observation_step`; where it `waited` nothing of it is stale, and row 0 is for the first free step.
    """

    chunk_id: int
    observation_step: int
    rows: Float64
    waited: bool = False


@dataclass(frozen=True, slots=True)
class Merged:
    """Where a chunk fell.

    `arrival_step` is the first tick not yet sent, `delay` = arrival_step - observation_step. `targets` int64 [H]
    is the step each row was planned for, -1 where it was dropped. `mistimed` steps were shifted by k_max.
    `dropped` says why nothing of the chunk was used, "" where something was.
    """

    chunk_id: int
    arrival_step: int
    delay: int
    targets: NDArray[np.int64]
    mistimed: int = 0
    dropped: str = ""
    overlap: int = 0  # steps from arrival_step on that were blended with what was planned before


class Query(ABC):
    """Decides when the policy is asked."""

    waits: bool = False  # it asks while the robot stands, so that nothing of the answer is stale
    continues: bool = False  # its requests carry what the robot is committed to (RTC)

    @abstractmethod
    def wants(self, progress: Progress) -> bool:
        """Whether to ask now."""


class Merge(ABC):
    """Lets a chunk join the timeline; a pure function of timeline, chunk and first free step."""

    waits: bool = False  # an empty timeline is this strategy's way of waiting, not starvation

    @abstractmethod
    def __call__(self, timeline: Timeline, arrival: Arrival, free_step: int) -> Merged:
        """Change `timeline` from `free_step` on and say where the rows went."""


def single(chunk_id: int, count: int) -> list[Makers]:
    """The makers of `count` rows that come from one chunk alone."""
    return [((chunk_id, 1.0),)] * count


def mixed(old: Sequence[Makers], weights: Sequence[float], chunk_id: int, count: int) -> list[Makers]:
    """The makers of `count` rows of which the first `len(weights)` were blended over from `old`."""
    made = single(chunk_id, count)
    for index, weight in enumerate(weights):
        if weight > 0.0:
            kept = tuple((maker, share * weight) for maker, share in old[index])
            made[index] = (*kept, (chunk_id, 1.0 - weight)) if weight < 1.0 else kept
    return made
