"""A run as control executes it: its plan, how chunks join it, and what it means when nothing is planned."""

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
from runtime.ipc.messages import ChunkMerged, Mode, PostedChunk
from runtime.motion.timeline import DimensionKinds, Timeline, difference
from runtime.processes.control.actuator import TickSettings
from runtime.processes.control.behaviours import Behaviour, Target
from runtime.recording.base import ControlSource
from runtime.strategies.base import ArrivedChunk, Merge, MergeResult, join

log = logging.getLogger(__name__)
_CHUNK_UNUSABLE = Pattern("control.chunk_unusable", "control cannot use it: {kind}: {error}")
_CHUNK_SHAPE = Pattern("control.chunk_shape", "it has the shape {shape}; expected [H, {width}], H from 1 on")
_CHUNK_BEGIN = Pattern("control.chunk_begin", "it means to begin at {given} numbers; expected {expected}")
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
_JOINED_AT_ONCE = 0.05  # [rad] that a run's first action may be off without being blended in
_ONE_BY_ONE: tuple[Mode, ...] = ("step", "preview")  # a person asks for each chunk


@dataclass(frozen=True, slots=True)
class Strategy:
    """The merging half of a strategy, and its kind."""

    kind: str
    merge: Merge


def build_strategy(section: Mapping[str, Any], dims: DimensionKinds) -> Strategy:
    """The strategy of a deployment's section `strategy`; ConfigurationError where it is none."""
    known = variants("runtime.strategies")
    kind = section.get("kind")
    if not isinstance(kind, str) or kind not in known:
        raise ConfigurationError(f"strategy.kind = {kind!r}; allowed: {', '.join(known)}")
    module = known[kind]
    try:
        config = module.Config.model_validate(dict(section))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise ConfigurationError(f"strategy.{key} = {first['input']!r}: {first['msg']}") from None
    return Strategy(kind, module.merge(config, dims))


class JoinResult(NamedTuple):
    """Result of joining a chunk; `far` says how far from where the robot stood it began, "" where it is near.

    `too_far`: it was not used for that.
    """

    merged: ChunkMerged
    distance_note: str = ""
    too_far: bool = False


class ExecuteChunks(Behaviour):
    """Executes the timeline of one run; None for a step that nothing is planned for."""

    name = "follow"
    moving = True

    def __init__(self, number: int, mode: Mode, chosen: Strategy, settings: TickSettings) -> None:
        self.number = number
        self.timeline = Timeline(len(settings.limits.lower))
        self._one_by_one = mode in _ONE_BY_ONE
        self._source: ControlSource = "teleop" if mode == "collect" else "policy"
        self._strategy = chosen
        self._settings = settings
        self._switched = False  # the kind of the strategy, since the last chunk that was merged
        # For the first chunk of all, or after a wait: no starvation yet, the policy's deadline bounds it.
        self._expecting = True
        self._useless = False  # the newest chunk was dropped though the robot had waited for it
        self._starved_since: float | None = None
        self.borne_until = float(
            "-inf"
        )  # a lost policy is tried again: an empty plan alone holds nothing before

    def target(self, step: int, elapsed: float) -> Target | None:
        planned = self.timeline.at(step)
        if planned is None:
            return None
        return Target(planned.action, self._source, "policy", planned.contributions)

    def ran_on(self, step: int, commanded: Float64) -> bool:
        """Whether what is planned for `step` has gone on while the robot, told to be at `commanded` [D], stood."""
        planned = self.timeline.at(step)
        if planned is None:
            return False
        apart = np.abs(difference(planned.action, commanded, self._settings.dims.wrapping))
        return bool(apart.max(where=self._settings.limits.position_mask, initial=0.0) > _JOINED_AT_ONCE)

    def begin_anew(self) -> None:
        """Forget what is planned: the next chunk is a first one, and the robot waits for it."""
        self.timeline.clear()
        self._expecting, self._useless, self._starved_since = True, False, None

    # --- chunks --------------------------------------------------------------------------------------------

    def tune(self, chosen: Strategy, step: int) -> None:
        """Merge by another strategy from now on; what is planned from `step` on stays."""
        self._switched = self._switched or chosen.kind != self._strategy.kind
        if self._starved_since is None and self.is_waiting and not self.timeline.remaining(step):
            self._expecting = True  # what the old strategy waited for is no gap of the new one
        self._strategy, self._useless = chosen, False

    def join(self, chunk: PostedChunk, step: int, commanded: Float64) -> JoinResult:
        """Let a chunk join the plan from `step`, the first one not yet sent, on; `commanded` [D] was sent last.

        One that is dropped, for whatever reason, ends the wait for the first; one that the robot waited for and
        that is of no use ends the waiting. Always dropped is starving.
        """
        try:
            joined = self._join(chunk, step, commanded)
        except Exception as error:  # about one chunk: it must not end what keeps the robot held
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
        # A policy that means to begin elsewhere is told by its first row; a late one has gone on by the first used.
        begin = arrival.rows[0] if chunk.intended_start is None else chunk.intended_start.astype(np.float64)
        if begin.shape != (dim,):
            return JoinResult(dropped_chunk(chunk, step, _CHUNK_BEGIN(given=list(begin.shape), expected=dim)))
        meant, where = self._first_action_distance(begin, commanded)
        if meant > safety.jump:
            reason = _TOO_FAR(where=where, allowed=safety.jump)
            return JoinResult(dropped_chunk(chunk, step, reason), reason, too_far=True)
        away, where = self._first_used_distance(arrival, step, commanded)
        far, late = _BLENDED_IN(where=where) if away > safety.first_action_far else "", away > safety.jump
        if late:  # the robot stood where the policy means to begin: no row of it is stale
            arrival, far = replace(arrival, requested_while_stopped=True), _BEGUN_LATE(where=where)
            away, where = self._first_used_distance(arrival, step, commanded)
        if away > safety.jump:
            reason = _TOO_FAR(where=where, allowed=safety.jump)
            return JoinResult(dropped_chunk(chunk, step, reason), reason, too_far=True)
        held = commanded if away > _JOINED_AT_ONCE or self.is_starved else None
        switched = self._switched
        merged = join(
            self._strategy.merge,
            self.timeline,
            arrival,
            step,
            held,
            self._settings.dims,
            joining=switched,
            commanded=commanded,
        )
        merged = replace(merged, mistimed=merged.delay) if late else merged
        self._switched = switched and bool(merged.dropped)
        return JoinResult(self._to_message(chunk, merged), far)

    def _first_used_distance(self, arrival: ArrivedChunk, step: int, commanded: Float64) -> tuple[float, str]:
        """The same of the first row that is not stale."""
        if not self._expecting:
            return 0.0, ""
        placed = self._strategy.merge.place(self.timeline, arrival, step)
        return self._first_action_distance(placed.rows[0], commanded) if len(placed.rows) else (0.0, "")

    def _first_action_distance(self, row: Float64, commanded: Float64) -> tuple[float, str]:
        """Distance of a run's first action from the robot [rad], and that in words; 0 for later ones."""
        settings = self._settings
        if not self._expecting or settings.safety.report_only:
            return 0.0, ""
        apart = difference(row, commanded, settings.dims.wrapping)
        away = np.where(settings.limits.position_mask, np.abs(apart), 0.0)
        worst, name = float(away.max()), settings.limits.names[int(away.argmax())]
        return worst, _FIRST_ACTION_FAR(joint=name, distance=worst)

    def _to_message(self, chunk: PostedChunk, merged: MergeResult) -> ChunkMerged:
        return ChunkMerged(
            chunk_id=merged.chunk_id,
            run=chunk.run,
            arrival_step=merged.arrival_step,
            delay=merged.delay,
            targets=merged.targets,
            mistimed=merged.mistimed,
            dropped=merged.dropped,
            strategy=self._strategy.kind,
            overlap=merged.overlap,
            contributions=merged.contributions,
        )

    def bear(self, until: float) -> None:
        """A lost policy is tried again until then; while nothing is planned one loss is borne, and not the next."""
        if self._starved_since is None or self.borne_until < self._starved_since:
            self.borne_until = until

    # --- nothing planned -----------------------------------------------------------------------------------

    @property
    def is_waiting(self) -> bool:
        """True if an empty timeline is as it should be: the operator, or the strategy, asks when it is."""
        if self._useless:
            return False
        return self._expecting or self._one_by_one or self._strategy.merge.requests_while_stopped

    @property
    def is_starved(self) -> bool:
        return self._starved_since is not None

    def update_starvation(self, now: float) -> float | None:
        """Nothing is planned for this tick: how long that has been so, 0 when it begins, None while it waits."""
        if self.is_waiting:
            return None
        if self._starved_since is None:
            self._starved_since = now
        return now - self._starved_since

    def end_starvation(self, now: float) -> float | None:
        """An action was sent: how long there was none before it, None where there was no gap."""
        since, self._starved_since = self._starved_since, None
        return None if since is None else now - since


def dropped_chunk(chunk: PostedChunk, step: int, why: str) -> ChunkMerged:
    """Report of a chunk that control has no use for."""
    nowhere = np.full(len(np.atleast_1d(chunk.rows)), -1, np.int64)
    return ChunkMerged(chunk.chunk_id, chunk.run, step, step - chunk.observation_step, nowhere, 0, why)
