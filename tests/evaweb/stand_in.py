"""A runtime without a robot: the real session, lease and sockets in a thread, under the test's hand."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
import zmq

from runtime.core.sentences import Pattern, within
from runtime.ipc.bus import CommandServer, Endpoints, EventLog, Key, Publisher
from runtime.ipc.identity import authenticate, missing_role, unverified_reason
from runtime.ipc.messages import Ack, AckStatus, Command, Event
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.session.machine import LEASE_COMMANDS, SessionMachine
from runtime.processes.coordinator.session.transitions import STOPPING, GuardFacts, SessionEvent
from tests.processes import PATIENCE_S

DIM = 14
_CHANGED = Pattern("session.changed", "{before} -> {after}: {reason}")  # as the coordinator says it


class NoOpActions:
    """In place of the coordinator's actions and parts: everything succeeds at once and moves nothing.

    `situation` is what the test says it is.
    """

    situation = GuardFacts()

    def __getattr__(self, name: str) -> NoOpActions:
        return self

    def __call__(self, *arguments: Any) -> Mapping[str, Any]:
        return {}


class FakeStation:
    """A station `name` whose folder is below `data`; `mute` says nothing at all; commands of the kinds in `swallows`
    never arrive."""

    def __init__(self, data: Path, name: str, ttl: float = 10 * PATIENCE_S) -> None:
        self.name = name
        self.ttl = ttl
        self.mute = False
        self.swallows: set[str] = set()
        self.commands: list[Command] = []
        self.pressed: list[Command] = []
        self.guard_says: AckStatus = "done"
        self.collect: dict[str, Any] | None = None
        self.aims: list[Command] = []
        self.aim_says = Ack("", "done", data={"joints": [0.2] * DIM, "reached": True})
        self.effects: Any = NoOpActions()
        self._folder = data / "stations" / name
        self.key = Key(self._folder)
        self._ended = threading.Event()
        self._do: list[Any] = []
        self.boot_up()

    def boot_up(self) -> None:
        """Begin as a runtime that was just started: new boot id, new addresses."""
        context: zmq.Context[Any] = zmq.Context.instance()
        self.boot = str(uuid4())
        self.events = EventLog()
        self.lease = Lease(self.ttl)
        self.session = SessionMachine(self.effects, self.lease, self.boot, time.monotonic)
        self._ended = threading.Event()
        self._main = CommandServer(context, self._folder, "commands")
        self._guard = CommandServer(context, self._folder, "estop")
        self._streams = Publisher(context, self._folder, "state", 64)
        self._cameras = Publisher(context, self._folder, "cameras", 16)
        endpoints = Endpoints(self._folder)
        endpoints.write("coordinator", {"commands": self._main.endpoint, "state": self._streams.endpoint})
        endpoints.write("media", {"cameras": self._cameras.endpoint})
        endpoints.write("guard", {"estop": self._guard.endpoint})
        self._thread = threading.Thread(target=self._run, args=(self._ended,), daemon=True)
        self._thread.start()

    def end(self, *, tidy: bool = False) -> None:
        """End as by a kill; `tidy`: nothing is left that says where it was."""
        self._ended.set()
        self._thread.join()
        for socket in (self._main, self._guard, self._streams, self._cameras):
            socket.close()
        if tidy:
            Endpoints(self._folder).clear()

    def enter(self, happening: SessionEvent, reason: str = "") -> None:
        """Let something happen to the session; returns when it has."""
        self.do(lambda: self._happen(happening, reason))

    def emit(self, kind: str, text: str = "", **data: Any) -> None:
        """An event; returns when it is in the log."""
        self.do(lambda: self.events.append(Event(kind, text, time.monotonic(), data=data)))

    def ready(self) -> None:
        """As after a set-up."""
        self.enter(SessionEvent.CONNECTED)
        self.do(lambda: self.session._enter(SessionState.READY, "set up"))

    def situated(self, situation: GuardFacts) -> None:
        """Let the guards of commands see this."""
        self.do(lambda: setattr(self.effects, "situation", situation))

    def do(self, work: Any) -> None:
        """Work in the thread of the runtime."""
        done = threading.Event()
        self._do.append((work, done))
        assert done.wait(PATIENCE_S)

    def publish(self, stream: str, content: Mapping[str, Any]) -> None:
        """Publish it once."""
        self.do(lambda: self._streams.publish(stream, content))

    def snapshot(self) -> dict[str, Any]:
        said = self._said()
        return said | {"sentences": within(said)}

    def _said(self) -> dict[str, Any]:
        return {
            "boot": self.boot,
            "clock": time.monotonic(),
            "station": self.name,
            "robot": "agilex_piper",
            **self.session.status(),
            "lease": self.lease.status(time.monotonic()),
            "collect": self.collect,
            "latency": float("nan"),
            "newest_event": self.events.newest,
        }

    def _happen(self, happening: SessionEvent, reason: str) -> None:
        before = self.session.state
        if self.session.handle_event(happening, reason):
            text = _CHANGED(before=before, after=self.session.state, reason=reason)
            data = {"state": str(self.session.state), "state_is": self.session.state_meaning()}
            self.events.append(Event("state", text, time.monotonic(), data=data))

    def _run(self, ended: threading.Event) -> None:
        due = 0.0
        while not ended.is_set():
            self._main.socket.poll(5)
            while self._do:
                work, done = self._do.pop(0)
                work()
                done.set()
            self._serve(self._main, self._answer)
            self._serve(self._guard, self._press)
            if time.monotonic() >= due and not self.mute:
                due = time.monotonic() + 0.03
                self._publish()

    def _serve(self, server: CommandServer, answer: Any) -> None:
        while (received := server.receive()) is not None:
            call, said = received
            command = authenticate(said, call.payload, call.signature, call.uid, self.key)
            if not self.mute and command.kind not in self.swallows:
                refusal = (
                    "" if command.kind in STOPPING else unverified_reason(command) or missing_role(command)
                )
                ack = Ack(command.uuid, "refused", refusal) if refusal else answer(command)
                server.answer(call, ack)

    def _answer(self, command: Command) -> Ack:
        if command.kind == "status":
            return Ack(command.uuid, "done", boot=self.boot, data=self.snapshot())
        if command.kind == "events_since":
            rows = self.events.since(command.args["number"])
            return Ack(command.uuid, "done", boot=self.boot, data={"events": rows})
        if command.kind == "aim":
            self.aims.append(command)
            return replace(self.aim_says, uuid=command.uuid)
        if command.kind not in LEASE_COMMANDS:
            self.commands.append(command)
        before = self.session.state
        ack = self.session.handle(command)
        if command.kind not in LEASE_COMMANDS:
            data = {"uuid": command.uuid, "from": str(before), "to": str(self.session.state)}
            text = f"{command.kind} by {command.user}: {ack.status}"
            self.events.append(Event("command", text, time.monotonic(), data=data))
        return ack

    def _press(self, command: Command) -> Ack:
        self.pressed.append(command)
        return Ack(command.uuid, self.guard_says, "every tick now sends the measured position")

    def _publish(self) -> None:
        self._streams.publish("state", self.snapshot())
        joints = np.full(DIM, 0.1, np.float32)
        self._streams.publish("joints", {"step": 1, "measured": joints, "commanded": joints, "engaged": True})
        self._cameras.publish("camera/cam_high", b"\xff\xd8 a picture")


def old_snapshot(station: FakeStation, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was started when states did not say what they mean."""
    today = station.snapshot
    monkeypatch.setattr(
        station, "snapshot", lambda: {key: said for key, said in today().items() if key != "state_is"}
    )
