"""A strategy has two halves: when to ask the policy (main), and how an answer joins the timeline (control)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.timeline import Makers, Timeline
from runtime.types import Float64


@dataclass(frozen=True, slots=True)
class Progress:
    """What the asking half may decide by."""

    remaining: int  # steps still planned
    in_flight: bool  # a request is out, or its answer has not been merged yet
    since_request: float  # [s] since the last request was sent; inf before the first


@dataclass(frozen=True, slots=True)
class Arrival:
    """A chunk at the control loop: rows [H, D] in command space and control rate, row 0 for `observation_step`."""

    chunk_id: int
    observation_step: int
    rows: Float64


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


class Query(ABC):
    """Decides when the policy is asked."""

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
