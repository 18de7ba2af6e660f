"""Coordinator process: answers stops at once and commands in turns.

It publishes snapshots at 10 Hz (5 Hz at rest) and joints at 30 Hz.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import zmq

from runtime.core import process_limits as descriptors
from runtime.core import process_limits as heap
from runtime.core.clock import MonotonicClock
from runtime.core.sentences import Pattern
from runtime.ipc.bus import (
    STREAM_HIGH_WATER,
    TOO_MANY,
    CommandServer,
    Endpoints,
    IncomingMessage,
    Key,
    Publisher,
)
from runtime.ipc.fair_queue import FairQueue, QueuedCommand
from runtime.ipc.identity import authenticate, missing_role, unverified_reason
from runtime.ipc.membership import rest_s
from runtime.ipc.messages import Ack, Command, Event
from runtime.processes.child import join_station
from runtime.processes.coordinator.assembly import assemble
from runtime.processes.coordinator.command_journal import CommandJournal
from runtime.processes.coordinator.coordinator import Coordinator
from runtime.processes.coordinator.inference.inference import DisplayedChunk
from runtime.processes.coordinator.inference.runners import ThreadRunner
from runtime.processes.coordinator.session.transitions import STOPPING

_REFUSED = Pattern("commands.refused", "{kind} by {who}: refused, {reason}")
_TOO_MANY_WAIT = Pattern(
    "commands.too_many_wait",
    "{kind}: {most} wait already for what is still being loaded: ask again",
)
_TOO_MANY_REQUESTS = Pattern("commands.too_many_requests", "process {pid} of this machine is refused: {why}")
_NOT_ON_DISK = Pattern("commands.not_journalled", "answers to commands are not on disk: {why}")

_NOT_JOURNALLED = ("status", "events_since", "aim", "lease_renew", "preflight_report", "policy_server")
_MOST_WAITING = 100  # commands
_SHARE = 8  # commands that are executed per turn, in addition to all stops
_FLOOD_S = 5.0  # [s] between two events about a flood
_PERIODS = {"state": 0.1, "joints": 1 / 30, "poses": 1 / 30}  # of streams [s]
_SLOWER = 2.0  # factor on the period of snapshots at rest, when every event causes a snapshot at once
_WORK_S = 0.004  # [s] between two polls while something is in progress


Answered = tuple[Command, Ack, IncomingMessage]


class CommandService:
    """Command server and publisher for the station's clients."""

    def __init__(self, coordinator: Coordinator, context: zmq.Context[Any]) -> None:
        self._coordinator = coordinator
        settings = coordinator.spec.deployment
        folder = settings.station_dir
        self._server = CommandServer(context, folder, "commands")
        self._turns = FairQueue(self._server, STOPPING, _SHARE)
        self._key = Key(folder)
        self._streams = Publisher(context, folder, "state", STREAM_HIGH_WATER)
        self._journal = CommandJournal(folder)
        coordinator.session.restore_answers(self._journal.answers)
        self._endpoints = Endpoints(folder)
        self._write_endpoints()
        self._bell = coordinator.shared.bells.get("coordinator")
        self._poller = zmq.Poller()
        for woken_by in (self._server.socket, self._streams.socket, self._bell and self._bell.descriptor):
            if woken_by is not None:
                self._poller.register(woken_by, zmq.POLLIN)
        self._due: dict[str, float] = {}
        self._read: list[str] = []  # streams of _PERIODS with a subscriber
        self._told = 0
        self._shown: DisplayedChunk | None = None
        self._unjournalled = ""
        self._waiting: list[QueuedCommand] = []  # for kinematics that are being loaded

    def _write_endpoints(self) -> None:
        where = {
            "commands": self._server.endpoint,
            "state": self._streams.endpoint,
            "boot": self._coordinator.boot,
        }
        self._endpoints.write("coordinator", where)

    def serve(self, timeout: float) -> None:
        """Wait up to `timeout` [s] for a command, then answer commands and publish what is due.

        All stops that have arrived are answered, and a limited number of other commands. A new subscriber, and a
        message of another process, end the wait too.
        """
        if not self._turns.has_waiting:
            self._poller.poll(math.ceil(timeout * 1000))
        if self._bell is not None:
            self._bell.hush()
        stops, commands = self._turns.take_turn()
        stopped = self._stop([(call, self._identified(call, command)) for call, command in stops])
        loading, self._waiting = self._waiting, []
        executed = self._execute(
            [*loading, *((call, self._identified(call, command)) for call, command in commands)]
        )
        journalled = [
            (command, ack) for command, ack, _ in (*stopped, *executed) if command.kind not in _NOT_JOURNALLED
        ]
        # Answers are journalled before they are sent, so that a repeated command is never executed twice after
        # a restart. Stops were answered already: they must not wait for the disk.
        if journalled:
            self._report_disk_failure(self._journal.append_all(journalled))
        for _, ack, call in executed:
            self._server.answer(call, ack)
        self._report_flood()
        self._publish()
        if any(
            [
                self._server.rebind_if_unreachable(),
                self._streams.rebind_if_unreachable(),
                self._endpoints.is_missing("coordinator"),
            ]
        ):  # a list: every call must be made
            self._write_endpoints()

    def _identified(self, call: IncomingMessage, command: Command) -> Command:
        return authenticate(command, call.payload, call.signature, call.uid, self._key)

    def _stop(self, stops: list[QueuedCommand]) -> list[Answered]:
        """Answer stops without waiting for the disk; return those that were not answered before, with their answers.

        Stops of the same kind, sender and lease in this turn are executed once and get the same answer.
        """
        first: dict[tuple[str, str, str, int], Ack] = {}
        fresh: list[Answered] = []
        for call, command in stops:
            same = (command.kind, command.user, command.holder, command.epoch)
            earlier = None if command.kind == "estop" else self._coordinator.session.answered(command)
            ack = earlier or first.get(same)
            if ack is None:
                ack = first[same] = self._coordinator.handle(command)
                fresh.append((command, ack, call))
            self._server.answer(call, replace(ack, uuid=command.uuid))
        return fresh

    def _execute(self, calls: list[QueuedCommand]) -> list[Answered]:
        """Execute commands; return the new answers, which are sent after they have been written to the disk."""
        fresh: list[Answered] = []
        for call, command in calls:
            if (first := self._coordinator.session.answered(command)) is not None:
                self._server.answer(call, first)
            elif refusal := unverified_reason(command) or missing_role(command):
                self._refuse(call, command, refusal)
            elif self._coordinator.queries.is_loading(command):
                self._defer(call, command)
            else:
                fresh.append((command, self._coordinator.handle(command), call))
        return fresh

    def _refuse(self, call: IncomingMessage, command: Command, reason: str) -> None:
        text = _REFUSED(kind=command.kind, who=command.user, reason=reason)
        self._emit_rate_limited("not_allowed", text)
        self._server.answer(call, Ack(command.uuid, "refused", reason, kind=command.kind))

    def _defer(self, call: IncomingMessage, command: Command) -> None:
        """Queue a command whose kinematics are still loading, without waiting; refuse it if too many are queued."""
        if len(self._waiting) < _MOST_WAITING:
            self._waiting.append((call, command))
        else:
            reason = _TOO_MANY_WAIT(kind=command.kind, most=_MOST_WAITING)
            self._server.answer(call, Ack(command.uuid, "refused", reason))

    def _report_flood(self) -> None:
        if (call := self._turns.refused) is not None:
            self._emit_rate_limited("flood", _TOO_MANY_REQUESTS(pid=call.pid, why=TOO_MANY))

    def _emit_rate_limited(self, kind: str, text: str) -> None:
        """Emit an event, unless there was one of its kind just before: a flood must not fill the record."""
        if (now := self._coordinator.client_clock.now()) >= self._due.get(kind, 0.0):
            self._due[kind] = now + _FLOOD_S
            self._coordinator.emit(Event(kind, text, self._coordinator.clock.now()))

    def _report_disk_failure(self, failure: str) -> None:
        """Emit one event when a disk failure begins."""
        if failure and not self._unjournalled:
            text = _NOT_ON_DISK(why=failure)
            self._coordinator.emit(Event("not_journalled", text, self._coordinator.clock.now()))
        self._unjournalled = failure

    def until_due(self) -> float:
        """Return the seconds until a subscribed stream is due; inf without subscribers."""
        due = min((self._due.get(stream, 0.0) for stream in self._read), default=math.inf)
        return max(0.0, due - self._coordinator.client_clock.now())

    def _publish(self) -> None:
        coordinator, now = self._coordinator, self._coordinator.client_clock.now()
        if begun := self._streams.poll_subscriptions():  # new subscribers get the present content at once
            self._due = {name: due for name, due in self._due.items() if not name.startswith(tuple(begun))}
        self._read = [stream for stream in _PERIODS if self._streams.has_subscriber(stream)]
        news = coordinator.events.newest != self._told
        if coordinator.rests and news:
            self._due.pop("state", None)
        contents = {"state": coordinator.snapshot, "joints": self._joints, "poses": self._poses}
        for stream in self._read:
            if now >= self._due.get(stream, 0.0):
                slower = _SLOWER if stream == "state" and coordinator.rests else 1.0
                self._due[stream] = now + slower * _PERIODS[stream]
                self._streams.publish(stream, contents[stream]())
        self._publish_chunk(now)
        if news:
            for event in coordinator.events.since(self._told):
                self._streams.publish("event", event)
            self._told = coordinator.events.newest

    def _publish_chunk(self, now: float) -> None:
        """Publish the newest chunk when it changes, and once a second for late subscribers."""
        if not self._streams.has_subscriber("chunk"):
            return
        displayed = self._coordinator.inference.shown
        if displayed is not self._shown or (displayed is not None and now >= self._due.get("chunk", 0.0)):
            self._shown = displayed
            self._due["chunk"] = now + 1.0
            self._streams.publish("chunk", {"chunk": 0} if displayed is None else self._chunk(displayed))

    def _chunk(self, displayed: DisplayedChunk) -> dict[str, Any]:
        """Return rows float32 [H, D], poses float32 [H, 8 * arms], and the step of each row (-1: none)."""
        return {
            "chunk": displayed.number,
            "run": displayed.run,
            "state": displayed.state,
            "observation_step": displayed.observation_step,
            "step": int(self._coordinator.shared.control.read()["step"]),
            "targets": displayed.targets,
            "rows": displayed.rows.astype(np.float32),
            "poses": self._coordinator.spaces.eef_of(displayed.rows),
            "overlap": displayed.overlap,
            "ik": dict(displayed.ik),
        }

    def _joints(self) -> dict[str, Any]:
        """Return the joints of the newest control step, float32 [D] for each stage from plan to measurement.

        `raw` is the newest chunk's action for the step, `planned` the action of all chunks before safety, `simulated`
        the command of the simulated robot; `raw` and `planned` are NaN if there is none. `chunk` is the number of the
        chunk that has the largest weight in the step, -1 if there is no chunk. `chunks` is the number of contributing
        chunks, and `limited` is whether safety has changed the action.
        """
        status, observation = (
            self._coordinator.shared.control.read(),
            self._coordinator.shared.observation.read(),
        )
        step = int(status["step"])
        raw, ticked = self._coordinator.inference.raw_action(step), bool(status["behaviour"])
        nothing = np.full(len(observation["qpos"]), np.nan, np.float32)
        return {
            "step": step,
            "measured": observation["qpos"].copy(),
            "raw": nothing if raw is None else raw.astype(np.float32),
            "planned": status["smoothed"].copy() if ticked else nothing,
            "commanded": status["commanded"].copy(),
            "engaged": bool(status["engaged"]),
            "simulated": status["simulated"].copy() if ticked else nothing,
            "chunk": int(status["chunk"]) if ticked else -1,
            "chunks": int(status["chunks"]),
            "limited": bool(status["limited"]),
        }

    def _poses(self) -> np.ndarray:
        """Return end effector vectors float32 [2, 8 * arms]: measured, commanded (NaN if not engaged)."""
        status, observation = (
            self._coordinator.shared.control.read(),
            self._coordinator.shared.observation.read(),
        )
        poses = self._coordinator.spaces.eef_of(np.stack([observation["qpos"], status["commanded"]]))
        if not status["engaged"]:
            poses[1] = np.nan
        return poses

    def close(self) -> None:
        self._server.close()
        self._streams.close()


def main() -> None:
    """Run the coordinator until the supervisor has ended."""
    heap.keep_freed_memory()
    descriptors.raise_file_limit()
    member = join_station("coordinator")
    deciding = assemble(member.spec, member.shared, MonotonicClock(), ThreadRunner())
    service = CommandService(deciding, zmq.Context.instance())
    wait_s = rest_s(member.spec.deployment.control.heartbeat_timeout_s)
    while not member.lifeline.is_cut:
        deciding.poll()
        service.serve(min(wait_s, service.until_due()) if deciding.rests else _WORK_S)
    deciding.close()
    service.close()


if __name__ == "__main__":
    main()
