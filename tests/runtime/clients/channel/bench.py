"""A whole station in lockstep behind real sockets, its control channel, and scripts that speak to it as they do."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any, Literal

import zmq

from runtime.clients.channel.holder_names import HolderNames
from runtime.clients.channel.server import ChannelServer
from runtime.clients.client import StationClient
from runtime.ipc.bus import CommandServer, Endpoints
from runtime.ipc.messages import Ack, Command
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.process import CommandService
from tests.processes import PATIENCE_MS, PATIENCE_S, eventually, joined
from tests.runtime.lockstep_station import Station, stubbed

_TICK_S = 0.003  # ten times as fast as life


class Bench:
    """Ticks in a thread, one of its `threads`; `channel` is its door's endpoint, which goes by the clock `now`."""

    silence_s = 60.0

    def __init__(
        self, folder: Path, scripts: Literal["apart", "together"] = "together", **settings: Any
    ) -> None:
        self.context: zmq.Context[Any] = zmq.Context()
        self.now = 0.0
        self.lock, self.frozen = threading.Lock(), False
        self._heard_out, self._ended = threading.Event(), threading.Event()
        self.station = Station(stubbed(folder, lease={"ttl_s": 60.0}, **settings))
        self.folder = self.station.spec.deployment.station_dir
        self._service = CommandService(self.station.coordinator, self.context)
        self._guard = CommandServer(self.context, self.folder, "estop")
        Endpoints(self.folder).write("guard", {"estop": self._guard.endpoint})
        self._open: list[Script] = []
        self.door = ChannelServer(
            *(self.context, 0, HolderNames("lab", scripts), self.silence_s),
            lambda name: _Patient(self, name),
            lambda: self.now,
        )
        self.channel = self.door.endpoint
        self.threads = [threading.Thread(target=run) for run in (self._tick, self._press, self._listen)]
        for thread in self.threads:
            thread.start()

    def _tick(self) -> None:
        while not self._ended.is_set():
            if not self.frozen:
                with self.lock:
                    self.station.tick()
                    self._service.serve(0.0)
            time.sleep(_TICK_S)

    def _press(self) -> None:
        while not self._ended.is_set():
            self._guard.socket.poll(10)
            if (received := self._guard.receive()) is not None:
                address, command = received
                guard = self.station.guard
                guard.press(command.user, command.args["why"])
                self._guard.answer(
                    address, Ack(command.uuid, "done", "every tick now sends the measured position")
                )

    def _listen(self) -> None:
        while not self._heard_out.is_set():
            self.door.serve(0.01)
        self.door.close()

    def script(self, **common: Any) -> Script:
        """A script with a connection of its own; `common` goes into each of its messages."""
        made = Script(self.channel, common)
        self._open.append(made)
        return made

    def reach(self, state: SessionState) -> None:
        eventually(lambda: self.station.state == state, f"{state}, not {self.station.state}")

    def kept(self) -> None:
        """The lease has been renewed since."""
        began = self._until()
        eventually(lambda: self._until() > began, "the lease is renewed")

    def _until(self) -> float:
        held = self.station.coordinator.lease.current(self.station.clock.now())
        return held.until if held else 0.0

    def close(self) -> None:
        """The door first: what it has asked of the station is answered by one that still ticks."""
        self.frozen = False
        self._heard_out.set()
        *station, door = self.threads
        joined(door)
        self._ended.set()
        for thread in station:
            joined(thread)
        for script in self._open:
            script.close()
        self._service.close()
        self._guard.close()
        self.station.close()
        self.context.term()


class _Patient(StationClient):
    """Waits as long as all of the tests for a station that answers; as it would for one that does not."""

    def __init__(self, bench: Bench, name: str) -> None:
        super().__init__(bench.folder, name)
        self._bench = bench

    def _command(self, kind: str, timeout: float, *given: Any, **named: Any) -> Ack:
        return super()._command(kind, self._patience(timeout), *given, **named)

    def _send(self, command: Command, timeout: float) -> Ack:
        return super()._send(command, self._patience(timeout))

    def _patience(self, timeout: float) -> float:
        return timeout if self._bench.frozen else PATIENCE_S


class Script:
    """A REQ socket and JSON, and nothing of ours: as existing scripts do it."""

    def __init__(self, endpoint: str, common: dict[str, Any]) -> None:
        self.context: zmq.Context[Any] = zmq.Context()
        self.socket: zmq.Socket[bytes] = self.context.socket(zmq.REQ)
        self.socket.linger = 0
        self.socket.connect(endpoint)
        self.common = common

    def send(self, **message: Any) -> Any:
        return self.raw(json.dumps(message | self.common).encode())

    def raw(self, *frames: bytes) -> Any:
        self.socket.send_multipart(frames)
        assert self.socket.poll(PATIENCE_MS), f"no answer to {frames!r:.200}"
        (answer,) = self.socket.recv_multipart()
        return json.loads(answer, parse_constant=_no_number)

    def cmd(self, verb: str, **more: Any) -> Any:
        return self.send(cmd=f"web:{verb}", **more)

    def command(self, kind: str, **arguments: Any) -> Any:
        return self.send(command=kind, arguments=arguments)

    def query(self, name: str, **more: Any) -> Any:
        answer = self.send(query=name, **more)
        assert answer["ok"], answer
        return answer["data"]

    def result(self, answer: Any) -> Any:
        """What became of a command that was accepted."""
        return eventually(lambda: self._over(answer["id"]), f"the end of {answer}")

    def _over(self, identity: str) -> Any:
        found = self.query("result", id=identity)
        return found if found["result"] != "accepted" else None

    def close(self) -> None:
        self.socket.close()
        self.context.term()


def _no_number(word: str) -> None:
    raise AssertionError(f"{word} is not JSON")
