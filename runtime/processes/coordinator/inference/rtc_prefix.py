"""Committed rows in the policy's own space and rate, which real-time chunking (RTC) continues."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.core.sentences import Pattern, fixed
from runtime.core.types import ActionChunk, Conditioning, Float32, Float64, Observation
from runtime.ipc.messages import MergeResult
from runtime.motion.timeline import HELD
from runtime.processes.coordinator.inference.chunk_mixture import Mixture, MixtureParts

_MODEL_ROWS_RELATIVE = fixed(
    "rtc.model_rows_relative",
    "RTC: the model's own rows are relative to an earlier observation, and only the model can convert them"
    " to the next one: they are not continued, requests go out without them",
)
_DELAY_BEYOND_PLAN = Pattern(
    "rtc.delay_beyond_plan",
    "RTC: an answer is expected after {steps:g} steps, but {left} are planned: the robot will stand "
    "before it arrives; allowed: a delay that fits, so ask more often, or raise "
    "strategy.execution_horizon, or take a faster policy",
)

_HAIR = 1e-9  # [rows] rounding tolerance of quotients of rates
Numbers = Float32 | Float64
Shares = dict[int, float]  # by chunk: its weight in a step; they sum to 1


@dataclass(frozen=True, slots=True)
class _PendingChunk:
    """Chunk that was sent to control, and is not merged yet."""

    chunk: ActionChunk
    observation_step: int
    waited: bool
    commands: Float64
    made: int  # number of its rows for which there are commands


@dataclass(frozen=True, slots=True)
class _CommittedChunk:
    """Chunk on the timeline: `rows` as received, with row 0 for control step `anchor`.

    The plan from control step `first` on consists of this chunk alone, except for the steps in `contributions`, to
    which other chunks contribute; `contributions` is None if that is unknown.
    """

    chunk: ActionChunk
    rows: Float32  # [T, W] in model space if the server returned that, else its actions
    commands: Float64  # [N, D] its joint rows, row 0 for `anchor`
    usable: int  # number of its rows for which there are actions
    anchor: int
    first: int
    end: int  # the step after the last planned one
    contributions: Mapping[int, Shares] | None
    pace: float  # rows per control step
    delay: int  # control steps from its observation to its arrival

    @property
    def kind(self) -> tuple[object, ...]:
        """Format of the chunk's numbers: space, mode, pose format, widths."""
        chunk = self.chunk
        return chunk.space, chunk.mode, chunk.pose, chunk.actions.shape[1], self.rows.shape[1]


class RtcPrefix:
    """Plan from a new observation on, in the format of the newest merged chunk.

    Rows are used as the policy returned them, and not as the joint rows derived from them, because joint rows are
    solved, snapped and resampled, so that the policy has never returned such numbers. If control has blended chunks,
    their rows are mixed with the same weights. If control fades over from a held target, or the contributions of the
    chunks are unknown, there is no conditioning.

    Control assigns the position of a chunk on the timeline. The chunk begins at the step of its observation, or shifted
    from there if it was mistimed; if the robot was waiting for the chunk, it begins at the step of its arrival. Time is
    counted in steps; neither a clock nor a thread is used. Method: Black et al., Real-Time Execution of Action Chunking
    Flow Policies, arXiv 2506.07339.

    `clear` increments `generation`: a response requested in an earlier generation is ignored.
    """

    def __init__(self, control_rate: float, mixture: Mixture | None = None) -> None:
        self._control_rate = control_rate
        self._mixture = Mixture() if mixture is None else mixture
        self.generation = 0  # generation of new requests, see `add_chunk`
        self.warning = ""  # about the newest `conditioning`, "" if there is none
        self.predicted_delay = 0  # [rows] of the newest `conditioning`
        self._on_the_way: dict[int, _PendingChunk] = {}
        self._merged: dict[int, _CommittedChunk] = {}  # by chunk, the newest last

    def clear(self) -> None:
        """Discard all commitments, including those of responses still in flight."""
        self.generation += 1
        self.warning = ""
        self.predicted_delay = 0
        self._on_the_way.clear()
        self._merged.clear()

    def add_chunk(
        self,
        chunk_id: int,
        chunk: ActionChunk,
        observation_step: int,
        waited: bool = False,
        generation: int | None = None,
        commands: Float64 | None = None,
    ) -> None:
        """Add the response to an observation of control step `observation_step`; it counts once control has merged it.

        `waited` is True if the robot was at rest until the response. `commands` [N, D] are the response's joint rows at
        control rate; if None, its actions are joint rows already. `generation` is the generation in which the request
        was sent; if None, the caller guarantees that `clear` was not called since.
        """
        if generation is None or generation == self.generation:
            rows = chunk.actions.astype(np.float64) if commands is None else commands
            pace = (chunk.rate or self._control_rate) / self._control_rate
            source_rows = len(rows) if commands is None else _source_row_count(len(commands), pace)
            self._on_the_way[chunk_id] = _PendingChunk(chunk, observation_step, waited, rows, source_rows)

    def on_merged(self, merged: MergeResult) -> None:
        """Commit a chunk that control has merged; a dropped chunk is removed."""
        answer = self._on_the_way.pop(merged.chunk_id, None)
        if answer is None or merged.dropped or merged.chunk_id < max(self._merged, default=-1):
            return
        chunk = answer.chunk
        rows = chunk.actions if chunk.model_actions is None else chunk.model_actions
        pace = (chunk.rate or self._control_rate) / self._control_rate
        over = [
            number for number, committed in self._merged.items() if committed.end < answer.observation_step
        ]
        for number in over:  # later requests are about later steps than all of its steps
            del self._merged[number]
        self._merged[merged.chunk_id] = _CommittedChunk(
            chunk=chunk,
            rows=rows,
            commands=answer.commands,
            usable=min(len(rows), len(chunk.actions), answer.made),
            anchor=merged.arrival_step if answer.waited else answer.observation_step + merged.mistimed,
            first=merged.arrival_step,
            end=int(merged.targets.max(initial=merged.arrival_step - 1)) + 1,
            contributions=_shares(merged),
            pace=pace,
            delay=merged.delay,
        )

    def conditioning(
        self,
        observation_step: int,
        delays: Sequence[int],
        quantile: float,
        execution_horizon: int | None,
        observation: Observation | None = None,
    ) -> Conditioning | None:
        """Return the conditioning of a request about `observation_step`; None if there is nothing to continue.

        There is nothing to continue if no chunk is merged, no row of the newest merged chunk is left, the plan is
        unknown, or the model's own rows are relative.

        `warning` is set in two cases. In the first, the response is expected after the last planned step; only planned
        rows then count as consumed until the response arrives. In the second, the model's own rows are relative, so
        that the result is None.

        A chunk with a rate of its own has no row exactly at the observation: its remaining rows are resampled.

        Args:
            observation_step: control step of the new observation.
            delays: recent measured delays [control steps]; if empty, the delay of the newest chunk is used.
            quantile: the delay that is predicted is this quantile of `delays`, in rows, rounded up.
            execution_horizon: number of steps [control steps] of the response that will be executed; None: the
                whole chunk. The present plan does not depend on it.
            observation: new observation. Rows that are not absolute are converted to be relative to it, as those of
                the response will be. It is required for such rows.
        """
        self.warning, self.predicted_delay = "", 0
        if not self._merged:
            return None
        committed = self._merged[max(self._merged)]
        chunk = committed.chunk
        if chunk.model_actions is not None and (chunk.mode != "absolute" or chunk.model_relative):
            self.warning = _MODEL_ROWS_RELATIVE
            return None
        passed = math.floor((observation_step - committed.anchor) * committed.pace + 0.5 + _HAIR)
        consumed = max(0, passed)
        steps = observation_step + np.arange(committed.usable - consumed) / committed.pace
        steps = steps[np.ceil(steps - _HAIR) < committed.end]
        if not len(steps):
            return None
        delay = _expected(delays or [committed.delay], quantile)
        self.predicted_delay = max(0, math.ceil(delay * committed.pace - _HAIR))
        self._judge(delay, committed.end - observation_step)
        previous = self._planned(committed, steps, passed, observation)
        if previous is None:
            return None
        last = committed.usable
        if committed.chunk.mode != "absolute":  # unplanned rows are not relative to the new observation
            last = min(last, len(steps))
        if execution_horizon is not None:
            last = min(last, math.ceil(execution_horizon * committed.pace - _HAIR))
        return Conditioning(previous, consumed, min(self.predicted_delay, len(steps)), last)

    def _planned(
        self, committed: _CommittedChunk, steps: Float64, passed: int, observation: Observation | None
    ) -> Float32 | None:
        """Return the rows of the chunk `committed`, where the rows at `steps` are replaced by the rows of the plan.

        Return None if the plan is unknown. `passed` is the row of the chunk nearest to the first step. Rows that are
        not absolute cannot be mixed with each other. In this case joints are mixed, and the result is converted to rows
        relative to `observation`.
        """
        contributions = [self._contributions_at(at) for at in steps.tolist()]
        if committed.chunk.mode != "absolute":
            return self._from_here(committed, steps, contributions, passed, observation)
        contributors = [
            shares for shares in contributions if shares is not None and self._same_kind(committed, shares)
        ]
        if len(contributors) < len(contributions):
            return None
        whole = _repeat_last_row(committed.rows, committed.usable)  # without refused rows
        exact = abs((steps[0] - committed.anchor) * committed.pace - max(0, passed)) < _HAIR
        alone = {max(self._merged): 1.0}
        mixed = [place for place, shares in enumerate(contributors) if not exact or shares != alone]
        if not mixed:
            return whole
        rows = whole.copy()
        mixed_rows = self._mixed(steps[mixed], [contributors[place] for place in mixed])
        if mixed_rows is None:
            return None
        rows[max(0, passed) + np.array(mixed)] = mixed_rows
        return rows

    def _from_here(
        self,
        committed: _CommittedChunk,
        steps: Float64,
        contributions: Sequence[Shares | None],
        passed: int,
        observation: Observation | None,
    ) -> Float32 | None:
        """Return the rows of `committed`, which are not absolute, with the plan for `steps` relative to `observation`.

        `contributions` has for each step the weights of the chunks that contribute to it, or None if they are unknown;
        then the result is None, too. `passed` is the row nearest to the first step.
        """
        assert observation is not None, (
            "rows that are not absolute need the observation that they are relative to"
        )
        contributors = [
            shares for shares in contributions if shares is not None and shares.keys() <= self._merged.keys()
        ]
        if len(contributors) < len(contributions):
            return None
        places = max(0, passed) + np.arange(len(steps))
        rows = committed.rows.copy()
        joints = self._mixture.joints(self._parts(steps, contributors, lambda one: (one.commands, 1.0)))
        newest = rows[places].astype(np.float64)
        rows[places] = self._mixture.relative(joints, newest, committed.chunk, observation)
        return _repeat_last_row(rows, int(places[-1]) + 1)

    def _same_kind(self, committed: _CommittedChunk, shares: Shares) -> bool:
        """Return True if all chunks in `shares` are merged and have the number format of `committed`."""
        chunks = [self._merged.get(number) for number in shares]
        return all(chunk is not None and chunk.kind == committed.kind for chunk in chunks)

    def _contributions_at(self, at: float) -> Shares | None:
        """Return the weights of chunks at control step `at`, interpolated between steps; None if unknown."""
        before = math.floor(at + _HAIR)
        part = at - before
        if part < _HAIR:
            return self._makers_of(before)
        contributions: Shares = {}
        for shares, weight in ((self._makers_of(before), 1.0 - part), (self._makers_of(before + 1), part)):
            if shares is None:
                return None
            for chunk, share in shares.items():
                contributions[chunk] = contributions.get(chunk, 0.0) + weight * share
        return contributions

    def _makers_of(self, step: int) -> Shares | None:
        number = max(
            (number for number, committed in self._merged.items() if committed.first <= step), default=HELD
        )
        committed = self._merged.get(number)
        if committed is None or committed.contributions is None or step >= committed.end:
            return None
        return committed.contributions.get(step, {number: 1.0})

    def _mixed(self, steps: Float64, contributions: Sequence[Shares]) -> Float64 | None:
        """Return the rows for these control steps, mixed by the weights `contributions`.

        None if rows in model space cannot be mixed linearly.
        """
        like, mixture = self._merged[max(self._merged)].chunk, self._mixture
        actions = self._parts(steps, contributions, lambda held: (held.chunk.actions, held.pace))
        if like.space == "joint":
            intended = mixture.joints(actions)
        else:
            commands = self._parts(steps, contributions, lambda held: (held.commands, 1.0))
            intended = mixture.poses(mixture.joints(commands), actions.newest, like)
        if like.model_actions is None:
            return intended
        if not mixture.mixes_linearly(mixture.numbers(actions, like), intended, like):
            return None
        return mixture.numbers(self._parts(steps, contributions, lambda held: (held.rows, held.pace)), like)

    def _parts(
        self,
        steps: Float64,
        contributions: Sequence[Shares],
        table: Callable[[_CommittedChunk], tuple[Numbers, float]],
    ) -> MixtureParts:
        """Return the components from which the rows for `steps` are mixed.

        `contributions` has the weights of the chunks at each of these steps. `table` returns two values for a chunk:
        the rows to use, and the number of these rows per control step.
        """
        numbers: list[Numbers] = []
        weights: list[Float64] = []
        newest = np.zeros(len(steps), np.int64)
        for number in sorted({number for shares in contributions for number in shares}):
            committed = self._merged[number]
            rows, pace = table(committed)
            share = np.array([shares.get(number, 0.0) for shares in contributions])
            places = np.clip((steps - committed.anchor) * pace, 0, len(rows) - 1)
            below = np.floor(places + _HAIR).astype(np.int64)
            part = np.clip(places - below, 0.0, 1.0)
            newest[share > 0.0] = len(numbers)
            numbers += [rows[below], rows[np.minimum(below + 1, len(rows) - 1)]]
            weights += [share * (1.0 - part), share * part]
        every = np.array(numbers, np.float64)
        return MixtureParts(every, np.array(weights), every[newest, np.arange(len(steps))])

    def _judge(self, delay: float, left: int) -> None:
        """Set the warning if the `left` remaining planned steps are fewer than the expected delay."""
        if delay > left:
            self.warning = _DELAY_BEYOND_PLAN(steps=delay, left=left)


def _source_row_count(commands: int, pace: float) -> int:
    """Return the number of policy rows from which `commands` commands were made by resampling.

    `pace` is the number of policy rows per command.
    """
    return math.ceil((commands - 1) * pace - _HAIR) + 1


def _repeat_last_row(rows: Float32, count: int) -> Float32:
    """Return the first `count` rows [T, W], the last of them repeated up to the original length.

    Servers may require that length.
    """
    return (
        rows
        if count >= len(rows)
        else np.concatenate([rows[:count], np.repeat(rows[count - 1 : count], len(rows) - count, axis=0)])
    )


def _expected(delays: Sequence[int], quantile: float) -> float:
    """Return the quantile of the delays [control steps]; if it is between two measured delays, the larger one."""
    return float(np.quantile(np.asarray(delays, np.float64), quantile, method="higher"))


def _shares(merged: MergeResult) -> dict[int, Shares] | None:
    """Return the weights of chunks at each step to which several chunks contribute; None if they are unknown."""
    if merged.contributions is None:
        return None
    shares: dict[int, Shares] = {}
    for step, chunk, weight in merged.contributions.tolist():
        shares.setdefault(int(step), {})[int(chunk)] = weight
    return shares
