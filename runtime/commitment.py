"""What the robot is committed to, in the policy's own space and rate: what real-time chunking (RTC) continues."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.messages import ChunkMerged
from runtime.types import ActionChunk, Conditioning, Float32

_HAIR = 1e-9  # of a row: what rates divided by rates are off by


@dataclass(frozen=True, slots=True)
class _Answer:
    """A chunk that is on its way to the timeline."""

    chunk: ActionChunk
    observation_step: int
    waited: bool


@dataclass(frozen=True, slots=True)
class _Commitment:
    """A chunk on the timeline: `rows` as the server gave them, row 0 for control step `anchor`."""

    rows: Float32  # [T, W] in model space where the server returned that, else its actions
    usable: int  # of these rows, those that there are actions for
    anchor: int
    pace: float  # rows per control step
    delay: int  # control steps from its observation to its arrival
    rebased: bool  # its rows are relative to an observation that is over


class Commitment:
    """Keeps the newest merged chunk as the server gave it, and says what of it is left for a new observation.

    Not the joint rows that the chunk became: those are solved, snapped and resampled, the policy never saw them.
    The chunk's place is the one control gave it: its observation step, shifted where it was mistimed, or the
    step of its arrival where the robot waited for it. Source of the method: Black et al., Real-Time Execution
    of Action Chunking Flow Policies, arXiv 2506.07339. No clock, no thread: steps are what it counts in.

    A reset is `clear`: `generation` rises, and an answer that was asked for in an earlier one never counts.
    """

    def __init__(self, control_rate: float) -> None:
        self._control_rate = control_rate
        self.generation = 0  # what a request is asked in, see `answered`
        self.warning = ""  # of the newest `conditioning`, "" where it fits
        self.predicted_delay = 0  # rows, of the newest `conditioning`
        self._on_the_way: dict[int, _Answer] = {}
        self._held: _Commitment | None = None
        self._newest = -1

    def clear(self) -> None:
        """The robot is committed to nothing, and no answer that is still out will change that."""
        self.generation += 1
        self.warning = ""
        self.predicted_delay = 0
        self._on_the_way.clear()
        self._held = None
        self._newest = -1

    def answered(
        self,
        chunk_id: int,
        chunk: ActionChunk,
        observation_step: int,
        waited: bool = False,
        generation: int | None = None,
    ) -> None:
        """The policy gave `chunk` for `observation_step`; it counts when control has merged it.

        `generation` is what it was when the request went out; without it the caller vouches that nothing was
        cleared since.
        """
        if generation is None or generation == self.generation:
            self._on_the_way[chunk_id] = _Answer(chunk, observation_step, waited)

    def merged(self, merged: ChunkMerged) -> None:
        """Control has put a chunk on the timeline, or dropped it: what was dropped commits nobody."""
        answer = self._on_the_way.pop(merged.chunk_id, None)
        if answer is None or merged.dropped or merged.chunk_id < self._newest:
            return
        chunk = answer.chunk
        rows = chunk.actions if chunk.model_actions is None else chunk.model_actions
        self._newest = merged.chunk_id
        self._held = _Commitment(
            rows=rows,
            usable=min(len(rows), len(chunk.actions)),
            anchor=merged.arrival_step if answer.waited else answer.observation_step + merged.mistimed,
            pace=(chunk.rate or self._control_rate) / self._control_rate,
            delay=merged.delay,
            rebased=chunk.mode == "relative" and chunk.model_actions is None,
        )

    def conditioning(
        self,
        observation_step: int,
        delays: Sequence[int],
        quantile: float,
        execution_horizon: int | None,
    ) -> Conditioning | None:
        """What a request about `observation_step` carries; None where nothing is left, or nothing was merged.

        `delays` are recent measured ones in control steps (that of the chunk itself where there are none); their
        `quantile` is predicted, in rows rounded up. `execution_horizon` is in control steps, None is the whole
        chunk. Sets `warning` where the answer is expected later than the rows last that may still be executed.

        At a rate of its own a chunk has no row exactly at the observation: the nearest one is the first that is
        left, so that a chain of chunks neither runs ahead nor falls behind.
        """
        self.warning, self.predicted_delay = "", 0
        held = self._held
        if held is None:
            return None
        if held.rebased:
            self.warning = (
                "RTC: the policy's rows are relative to an observation that is over and it returned none of its own "
                "space: they cannot be continued, requests go out without them"
            )
            return None
        passed = math.floor((observation_step - held.anchor) * held.pace + 0.5 + _HAIR)
        consumed = max(0, passed)
        last = held.usable
        if execution_horizon is not None:
            last = min(last, math.ceil(execution_horizon * held.pace - _HAIR))
        if consumed >= last:
            return None
        self.predicted_delay = _rows_of(delays or [held.delay], quantile, held.pace)
        self._judge(last - consumed, last)
        return Conditioning(_from(held.rows, passed), consumed, self.predicted_delay, last)

    def _judge(self, left: int, last: int) -> None:
        """RTC needs rows to go on with until the answer arrives."""
        if self.predicted_delay > left:
            self.warning = (
                f"RTC: an answer is expected after {self.predicted_delay} rows, but {left} of the {last} that may be "
                "executed are left: the robot will stand before it arrives; allowed: a delay that fits, so ask more "
                "often, or raise strategy.execution_horizon, or take a faster policy"
            )


def _rows_of(delays: Sequence[int], quantile: float, pace: float) -> int:
    """The quantile of the delays, one that was measured, as rows that pass meanwhile."""
    delay = float(np.quantile(np.asarray(delays, np.float64), quantile, method="higher"))
    return max(0, math.ceil(delay * pace - _HAIR))


def _from(rows: Float32, passed: int) -> Float32:
    """The rows; where they begin after the observation (the robot had waited), the first is repeated before them."""
    if passed >= 0:
        return rows
    return np.concatenate([np.repeat(rows[:1], -passed, axis=0), rows])[: len(rows)]
