"""Telemetry of ticks: control's status for all, events for the coordinator, tick records for media."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from runtime.core.sentences import Pattern
from runtime.core.types import ControlSource, Float32, Float64
from runtime.ipc.messages import Event, ExecutedTick, MergeResult, Message, encode
from runtime.ipc.observation_reader import LatestObservation
from runtime.ipc.shared_state import JOINT_PROBLEM_BYTES, SharedState
from runtime.motion.timeline import HELD, Contributions
from runtime.processes.control.actuator import Actuator, TickResult
from runtime.processes.control.behaviours import Behaviour, EStopHold
from runtime.safety.collision import Collision

_LIMITED_SUM = Pattern("control.limited_sum", "{count} actions were limited, worst: {worst}")
_NEAR_SUM = Pattern("control.near_sum", "{count} actions came too near, nearest: {nearest}")

StatusRecord = np.ndarray[Any, np.dtype[np.void]]  # of SharedStateLayout.control_dtype, without dimensions
_TOLD = 1e-4  # [rad] smaller changes are rounding at a limit
_QUIET_S = 1.0  # [s] without a change by safety, after which a sum is reported and the next change is new


@dataclass(frozen=True, slots=True)
class TickState:
    """State of control at the end of a tick."""

    robot: Actuator
    trusted_joints: bool  # the robot's position is known
    implausible_reason: str  # why measurements are implausible, or not at the commanded position
    behaviour: Behaviour  # the robot's
    simulating: bool  # the simulated robot executes a run
    simulated: Float64 | None  # [D] the simulated robot's command
    remaining: int  # steps planned after this one
    waiting: bool
    starved: bool
    refused: int
    locked: Float64  # [D]


class LimitingMonitor:
    """Monitor of actions that safety limits.

    It emits one event at the beginning of a period of limiting, and a summary at its end.
    """

    def __init__(self, say: Callable[[str, str], None]) -> None:
        self._say = say
        self._last = float("-inf")
        self._count, self._worst, self._most = 0, 0.0, ""

    def update(self, sent: TickResult, now: float) -> None:
        """Count the tick if its action was limited; begin or end the period of limiting."""
        if sent.change > _TOLD:
            if not self._count:
                self._say("limited", sent.limited)
            if sent.change > self._worst:
                self._worst, self._most = sent.change, sent.limited
            self._count, self._last = self._count + 1, now
        elif self._count and now - self._last >= _QUIET_S:
            self.close()

    def close(self) -> None:
        """End the period of limiting, if there is one, and emit its summary."""
        if self._count:
            self._say("limited_sum", _LIMITED_SUM(count=self._count, worst=self._most))
        self._count, self._worst, self._most = 0, 0.0, ""


class ProximityMonitor:
    """Monitor of actions that bring links near each other.

    It emits one event at the beginning of a period, and a summary at its end.
    """

    def __init__(self, say: Callable[[str, str], None]) -> None:
        self._say = say
        self._last = float("-inf")
        self._count = 0
        self._nearest: Collision | None = None

    def update(self, sent: TickResult, now: float) -> None:
        """Count the tick if its action brings links near each other; begin or end the period of proximity."""
        near = sent.near
        if near is not None:
            if self._nearest is None:
                self._say("near", str(near))
            if self._nearest is None or near.distance < self._nearest.distance:
                self._nearest = near
            self._count, self._last = self._count + 1, now
        elif self._count and now - self._last >= _QUIET_S:
            self.close()

    def close(self) -> None:
        """End the period of proximity, if there is one, and emit its summary."""
        if self._count:
            self._say("near_sum", _NEAR_SUM(count=self._count, nearest=self._nearest))
        self._count, self._nearest = 0, None


class Telemetry:
    """Collector of a tick's messages, sent at its end; if a ring is full, messages are lost and counted."""

    def __init__(self, shared: SharedState) -> None:
        self._shared_state = shared
        self._outbox: list[MergeResult | Event] = []
        self._records_lost = 0
        self._step, self.planned = -1, 0.0
        self._woke: float | None = None
        self._corrected = float("-inf")  # time of the last change by the command limiter
        self._smoothed: Float32 | None = None  # this tick's action before safety
        self.status: StatusRecord = np.zeros((), shared.layout.control_dtype())  # written whole by every tick
        self.status[()] = shared.control.read()  # counters continue those of a predecessor
        self.limiting = LimitingMonitor(self.emit)
        self.nearing = ProximityMonitor(self.emit)
        self.order = 0  # number of the newest order obeyed
        self.run = 0

    def begin_tick(self, step: int, planned: float, woke: float | None = None) -> None:
        """Begin the tick `step`, to which later calls belong.

        The tick was planned for `planned`, and the loop woke at `woke`.
        """
        self._step, self.planned, self._woke = step, planned, woke

    def emit(self, kind: str, text: str, data: Mapping[str, object] = MappingProxyType({})) -> None:
        """Queue an event, which is sent at the end of the tick.

        The event contains the number of the newest order of the coordinator that control has obeyed.
        """
        self._outbox.append(Event(kind, text, self.planned, self._step, {"order": self.order, **data}))

    def add_merge(self, merged: MergeResult) -> None:
        """Queue the report on the steps at which the rows of a chunk were placed; it is sent at the end of the tick."""
        self._outbox.append(merged)

    def add_tick(self, seen: LatestObservation, sent: TickResult, simulated: bool) -> None:
        """Count the tick in all monitors, and send its record to media unless media needs none.

        `simulated` is True if the result `sent` is that of the simulated robot.
        """
        self.limiting.update(sent, self.planned)
        self._note_corrected(sent)
        self.nearing.update(sent, self.planned)
        target, executed = sent.target, sent.executed
        is_planned = target is not None and target.path is not None
        self._smoothed = target.action.astype(np.float32) if target and is_planned else None
        makers = target.contributions if target else ()
        self._emit_contributions(makers, sent)
        if self._shared_state.unrecorded:
            return
        executed_tick = ExecutedTick(
            step=self._step,
            run=self.run,
            planned=self.planned,
            sent=sent.time,
            sequence=seen.sequence,
            source=_source(sent, simulated),
            qpos=seen.qpos,
            smoothed=self._smoothed,
            executed=None if executed is None else executed.astype(np.float32),
            chunk_ids=[maker for maker, _ in makers],
            weights=[share for _, share in makers],
            notes=list(sent.notes),
            refused=sent.refused,
            woke=self._woke,
        )
        self._push("ticks", executed_tick)

    def publish(self, seen: LatestObservation, standing: TickState) -> None:
        """Publish control's status, and only then its events.

        The coordinator interprets events by the status, so an event must not arrive first. The tick's record precedes
        both, so that an episode ended by them loses no row.
        """
        status, robot = self.status, standing.robot
        status["step"], status["planned"] = self._step, self.planned
        status["sequence"], status["order"] = seen.sequence, self.order
        name = "simulate" if standing.simulating else standing.behaviour.name
        status["run"], status["behaviour"] = self.run, name.encode()
        status["remaining"], status["refused_in_row"] = standing.remaining, standing.refused
        status["engaged"], status["moving"] = robot.engaged, standing.behaviour.moving
        status["estop_obeyed"] = isinstance(standing.behaviour, EStopHold)
        status["commanded"], status["velocity"] = robot.commanded, robot.velocity
        status["smoothed"] = np.nan if self._smoothed is None else self._smoothed
        status["simulated"] = np.nan if standing.simulated is None else standing.simulated
        status["waiting"], status["starved"] = standing.waiting, standing.starved
        status["locked"] = standing.locked
        status["believed"], status["doubt"] = (
            standing.trusted_joints,
            standing.implausible_reason.encode()[:JOINT_PROBLEM_BYTES],
        )
        status["records_lost"] = self._records_lost
        self._shared_state.control.write(status)
        for message in self._outbox:
            self._push("control_events", message)
            self._push("ticks", message)
        self._outbox.clear()

    def _note_corrected(self, sent: TickResult) -> None:
        if sent.corrected and self.planned - self._corrected > _QUIET_S:
            self.emit("corrected", sent.corrected)
        self._corrected = self.planned if sent.corrected else self._corrected

    def _emit_contributions(self, makers: Contributions, sent: TickResult) -> None:
        if sent.target is not None and sent.target.source == "teleop":
            makers = ()  # a leader's messages are merged like chunks, but must not be counted as chunks
        status = self.status
        status["chunk"] = max(makers, key=lambda made: made[1])[0] if makers else -1
        status["chunks"] = sum(maker != HELD for maker, _ in makers)
        status["limited"] = bool(sent.limited) or sent.refused

    def _push(self, ring: str, message: Message) -> None:
        if not self._shared_state.rings[ring].push(encode(message)):
            self._records_lost += 1


def _source(sent: TickResult, simulated: bool) -> ControlSource:
    if sent.executed is None:
        return "none"
    if sent.target is None or sent.refused:
        return "sim" if simulated else "hold"
    return "sim" if simulated and sent.target.source == "policy" else sent.target.source
