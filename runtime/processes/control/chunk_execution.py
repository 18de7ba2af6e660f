"""Execution of a run: its timeline, merging of chunks, and starvation."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from runtime.core.errors import ConfigurationError
from runtime.core.plugins import variants
from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.ipc.messages import MergeResult, Mode, Order, PostedChunk
from runtime.motion.timeline import DimensionKinds, Timeline, difference
from runtime.processes.control.actuator import TickSettings
from runtime.processes.control.behaviours import Behaviour, Target
from runtime.strategies.base import ArrivedChunk, Merge, join

log = logging.getLogger(__name__)
_CHUNK_UNUSABLE = Pattern("control.chunk_unusable", "control cannot use it: {kind}: {error}")
_CHUNK_SHAPE = Pattern("control.chunk_shape", "it has the shape {shape}; expected [H, {width}], H from 1 on")
_CHUNK_BEGIN = Pattern("control.chunk_begin", "intended start: {given} values; expected {expected}")
_TOO_FAR = Pattern(
    "control.too_far",
    "{where}, allowed {allowed:g} (safety.jump): approach it, or start elsewhere",
)
_BLENDED_IN = Pattern("control.blended_in", "{where}: blended in")
_BEGUN_LATE = Pattern(
    "control.begun_late",
    "{where} by now: the robot stood meanwhile, and begins with the first row of the answer",
)
_FIRST_ACTION_FAR = Pattern(
    "control.first_action_far",
    "{joint}: the first action is {distance:.2f} rad from where the robot stands",
)
_JOINED_AT_ONCE = 0.05  # [rad] offset of a run's first action that is not blended in
_ONE_BY_ONE: tuple[Mode, ...] = ("step", "preview")  # a person requests each chunk


@dataclass(frozen=True, slots=True)
class Strategy:
    """Part of a strategy that merges chunks into the plan, with the strategy's kind."""

    kind: str
    merge: Merge


def build_strategy(section: Mapping[str, Any], dims: DimensionKinds) -> Strategy:
    """Return the strategy of a deployment's section `strategy`.

    Raises:
        ConfigurationError: unknown kind or invalid parameters.
    """
    modules = variants("runtime.strategies")
    kind = section.get("kind")
    if not isinstance(kind, str) or kind not in modules:
        raise ConfigurationError(f"strategy.kind = {kind!r}; allowed: {', '.join(modules)}")
    module = modules[kind]
    try:
        config = module.Config.model_validate(dict(section))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise ConfigurationError(f"strategy.{key} = {first['input']!r}: {first['msg']}") from None
    return Strategy(kind, module.merge(config, dims))


class JoinResult(NamedTuple):
    """Result of joining a chunk to the plan.

    `distance_note` describes how far the chunk's start is from the robot, "" if it is near. If `too_far`, the chunk was
    dropped for that reason.
    """

    merged: MergeResult
    distance_note: str = ""
    too_far: bool = False


class ExecuteChunks(Behaviour):
    """Behaviour that executes the timeline of one run."""

    name = "follow"
    moving = True

    def __init__(self, order: Order, chosen: Strategy, settings: TickSettings) -> None:
        self.number = order.run
        self.timeline = Timeline(len(settings.limits.lower))
        self._one_by_one = order.mode in _ONE_BY_ONE
        self._source = order.source
        self._strategy = chosen
        self._settings = settings
        self._switched = False  # kind of strategy changed since the last merged chunk
        # Before the first chunk, or after a wait, nothing starves: the policy's deadline limits it.
        self._expecting = True
        self._useless = False  # the newest chunk was dropped, although the robot was waiting for it
        self._starved_since: float | None = None
        # While a lost policy is retried, an empty plan does not lead to holding.
        self.borne_until = float("-inf")

    def target(self, step: int, elapsed: float) -> Target | None:
        planned = self.timeline.at(step)
        if planned is None:
            return None
        return Target(planned.action, self._source, "policy", planned.contributions)

    def ran_on(self, step: int, commanded: Float64) -> bool:
        """Return True if the plan for `step` has moved away from `commanded` [D], the command at which the robot
        stopped.
        """
        planned = self.timeline.at(step)
        if planned is None:
            return False
        apart = np.abs(difference(planned.action, commanded, self._settings.dims.wrapping))
        return bool(apart.max(where=self._settings.limits.position_mask, initial=0.0) > _JOINED_AT_ONCE)

    def begin_anew(self) -> None:
        """Discard the plan: the next chunk counts as the first, and the robot waits for it."""
        self.timeline.clear()
        self._expecting, self._useless, self._starved_since = True, False, None

    # --- chunks --------------------------------------------------------------------------------------------

    def tune(self, chosen: Strategy, step: int) -> None:
        """Merge with another strategy from now on; the plan from `step` on is kept."""
        self._switched = self._switched or chosen.kind != self._strategy.kind
        if self._starved_since is None and self.is_waiting and not self.timeline.remaining(step):
            self._expecting = True  # a wait of the old strategy is no gap of the new one
        self._strategy, self._useless = chosen, False

    def join(self, chunk: PostedChunk, step: int, commanded: Float64) -> JoinResult:
        """Merge a chunk into the plan from `step` on, the first step not sent yet.

        `commanded` [D] is the newest command. After this call the run no longer waits for its first chunk, even if this
        chunk was dropped. If a dropped chunk was requested while the robot was stopped, an empty plan counts as
        starvation from then on, and not as waiting: otherwise a policy whose chunks are all dropped would let the run
        wait forever.
        """
        try:
            joined = self._join(chunk, step, commanded)
        except Exception as error:  # of a single chunk: it must not end the process that holds the robot
            log.exception("chunk %d cannot be used", chunk.chunk_id)
            joined = JoinResult(
                dropped_chunk(chunk, step, _CHUNK_UNUSABLE(kind=type(error).__name__, error=error))
            )
        self._expecting = False
        self._useless = bool(joined.merged.dropped) and chunk.requested_while_stopped
        return joined

    def _join(self, chunk: PostedChunk, step: int, commanded: Float64) -> JoinResult:
        rows, dim = chunk.rows, len(commanded)
        if rows.ndim != 2 or rows.shape[1] != dim or not len(rows):
            shape = _CHUNK_SHAPE(shape=list(rows.shape), width=dim)
            return JoinResult(dropped_chunk(chunk, step, shape))
        arrival = ArrivedChunk(
            chunk.chunk_id, chunk.observation_step, rows.astype(np.float64), chunk.requested_while_stopped
        )
        safety = self._settings.safety
        # The policy's intention is its first row; if the chunk is late, the first row used is already farther
        # on.
        begin = arrival.rows[0] if chunk.intended_start is None else chunk.intended_start.astype(np.float64)
        if begin.shape != (dim,):
            return JoinResult(dropped_chunk(chunk, step, _CHUNK_BEGIN(given=list(begin.shape), expected=dim)))
        distance, where = self._first_action_distance(begin, commanded)
        if distance > safety.jump:
            reason = _TOO_FAR(where=where, allowed=safety.jump)
            return JoinResult(dropped_chunk(chunk, step, reason), reason, too_far=True)
        away, where = self._first_used_distance(arrival, step, commanded)
        far, late = _BLENDED_IN(where=where) if away > safety.first_action_far else "", away > safety.jump
        if late:  # the robot was at rest at the policy's intended start: no row is stale
            arrival, far = replace(arrival, requested_while_stopped=True), _BEGUN_LATE(where=where)
            away, where = self._first_used_distance(arrival, step, commanded)
        if away > safety.jump:
            reason = _TOO_FAR(where=where, allowed=safety.jump)
            return JoinResult(dropped_chunk(chunk, step, reason), reason, too_far=True)
        start = commanded if away > _JOINED_AT_ONCE or self.is_starved else None
        switched = self._switched
        merged = join(
            self._strategy.merge,
            self.timeline,
            arrival,
            step,
            start,
            self._settings.dims,
            joining=switched,
            commanded=commanded,
        )
        self._switched = switched and bool(merged.dropped)
        mistimed = merged.delay if late else merged.mistimed
        return JoinResult(
            replace(merged, mistimed=mistimed, run=chunk.run, strategy=self._strategy.kind), far
        )

    def _first_used_distance(self, arrival: ArrivedChunk, step: int, commanded: Float64) -> tuple[float, str]:
        """Return how far the first row of a chunk that would be used is from `commanded` [rad], and a description.

        Rows for past steps are not used. Return 0 and "" if the chunk is not the first of the run, or none of its rows
        would be used.
        """
        if not self._expecting:
            return 0.0, ""
        placed = self._strategy.merge.place(self.timeline, arrival, step)
        return self._first_action_distance(placed.rows[0], commanded) if len(placed.rows) else (0.0, "")

    def _first_action_distance(self, row: Float64, commanded: Float64) -> tuple[float, str]:
        """Return how far `row` [D], a run's first action, is from `commanded` [rad], and a description.

        Return 0 and "" if the run has had its first chunk already, or if safety only reports.
        """
        settings = self._settings
        if not self._expecting or settings.safety.report_only:
            return 0.0, ""
        apart = difference(row, commanded, settings.dims.wrapping)
        away = np.where(settings.limits.position_mask, np.abs(apart), 0.0)
        worst, name = float(away.max()), settings.limits.names[int(away.argmax())]
        return worst, _FIRST_ACTION_FAR(joint=name, distance=worst)

    def bear(self, until: float) -> None:
        """Tolerate until time `until` that no action is planned, because requests to a lost policy are being retried.

        Within one gap without planned actions only the first call has an effect.
        """
        if self._starved_since is None or self.borne_until < self._starved_since:
            self.borne_until = until

    # --- nothing planned -----------------------------------------------------------------------------------

    @property
    def is_waiting(self) -> bool:
        """Whether an empty timeline is expected: the operator or the strategy decides about the next request."""
        if self._useless:
            return False
        return self._expecting or self._one_by_one or self._strategy.merge.requests_while_stopped

    @property
    def is_starved(self) -> bool:
        return self._starved_since is not None

    def update_starvation(self, now: float) -> float | None:
        """Record that nothing is planned for this tick.

        Returns:
            Duration of the gap so far [s], 0 on its first tick; None while waiting is expected.
        """
        if self.is_waiting:
            return None
        if self._starved_since is None:
            self._starved_since = now
        return now - self._starved_since

    def end_starvation(self, now: float) -> float | None:
        """End the gap, because an action was sent; return its duration [s], or None if there was none."""
        since, self._starved_since = self._starved_since, None
        return None if since is None else now - since


def dropped_chunk(chunk: PostedChunk, step: int, why: str) -> MergeResult:
    """Return the report of a chunk that control does not use."""
    nowhere = np.full(len(np.atleast_1d(chunk.rows)), -1, np.int64)
    return MergeResult(chunk.chunk_id, step, step - chunk.observation_step, nowhere, 0, why, chunk.run)
