"""What a second account of this machine can do to a station: nothing, and with the doors left open press the e-stop."""

from __future__ import annotations

import json
import os
import socket
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zmq

from runtime.ipc.bus import Endpoints, Key
from runtime.ipc.messages import Command, encode
from runtime.ipc.shared_state import EStop
from runtime.processes.coordinator.process import CommandService
from runtime.processes.guard.process import EStopServer
from tests.processes import PATIENCE_MS
from tests.runtime.lockstep_station import Station, stubbed

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="to be another account one has to be root")
NOBODY = 65534


def tried(work: Callable[[], object]) -> str:
    try:
        work()
    except OSError as error:
        return type(error).__name__
    return "done"


def _connected(place: str) -> None:
    with socket.socket(socket.AF_UNIX) as wire:
        wire.connect(place.removeprefix("ipc://"))


def asked(place: str, *commands: Command) -> list[str]:
    """The answers to commands that are sent to a socket one by one, as texts."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as wire:
        wire.linger = 0
        wire.connect(place)
        found = []
        for command in commands:
            wire.send(encode(command))
            found.append(wire.recv().decode("latin-1") if wire.poll(PATIENCE_MS) else "no answer")
        return found


class Bench:
    """Main's and the guard's sockets of a station in lockstep."""

    def __init__(self, folder: Path) -> None:
        self.context: zmq.Context[Any] = zmq.Context()
        self.station = Station(stubbed(folder))
        self.folder = self.station.spec.deployment.station_dir
        self.coordinator = CommandService(self.station.coordinator, self.context)
        self.guard = EStopServer(
            self.station.guard, self.station.coordinator.shared, self.context, self.folder
        )
        Key(self.folder).secret()
        read = Endpoints(self.folder).read
        self.places = {
            "coordinator": str(read("coordinator")["commands"]),
            "guard": str(read("guard")["estop"]),
        }

    def nobody(self, work: Callable[[], Any]) -> Any:
        """What the work comes to in a process of another account, as JSON has it."""
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            told: Any = "it failed"
            try:
                os.setgroups([])
                os.setresgid(NOBODY, NOBODY, NOBODY)
                os.setresuid(NOBODY, NOBODY, NOBODY)
                told = work()
            finally:
                os.write(writing, json.dumps(told).encode())
                os._exit(0)
        os.close(writing)
        while os.waitpid(child, os.WNOHANG)[0] == 0:
            self.coordinator.serve(0.01)
            self.guard.serve(0.01)
        with open(reading, "rb") as pipe:
            return json.loads(pipe.read())

    def close(self) -> None:
        self.guard.close()
        self.coordinator.close()
        self.station.close()
        self.context.destroy(linger=0)


@pytest.fixture
def bench() -> Iterator[Bench]:
    """Its data folder can be entered by anybody: what must not be read says so itself."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        made = Bench(Path(folder))
        yield made
        made.close()


def test_another_account_reads_no_key_says_nothing_and_connects_nowhere(bench: Bench) -> None:
    key, folder = Key(bench.folder).path, bench.folder
    tries = [
        key.read_bytes,
        lambda: key.write_bytes(b"mine"),
        (folder / "endpoints" / "guard.json").unlink,
        *(partial(_connected, place) for place in bench.places.values()),
    ]
    assert bench.nobody(lambda: [tried(work) for work in tries]) == ["PermissionError"] * len(tries)


def test_where_the_sockets_are_left_open_it_commands_nothing_and_may_press(bench: Bench) -> None:
    path = Path(bench.places["coordinator"].removeprefix("ipc://"))
    opened = [path.parent, path.parents[1], path.parents[2]]
    before = [(folder, folder.stat().st_mode & 0o777) for folder in opened]
    try:
        for folder in opened:
            folder.chmod(0o755)
        for one in bench.places.values():
            Path(one.removeprefix("ipc://")).chmod(0o777)
        claim = Command("c", "lease_claim", user="root", holder="web:root:p1", epoch=1, role="admin")
        local = Command("d", "setup", user="root", holder="terminal:root@here", role="local")
        for answer in bench.nobody(lambda: asked(bench.places["coordinator"], claim, local)):
            assert "refused" in answer
            assert "not signed by this lab's web" in answer
        assert bench.station.coordinator.shared.estop is not EStop.LATCHED
        press = Command("e", "estop", {"why": "smoke"}, user="root")
        (answer,) = bench.nobody(lambda: asked(bench.places["guard"], press))
        assert "latched" in answer or "measured position" in answer
        assert bench.station.coordinator.shared.estop is EStop.LATCHED
        assert json.loads((bench.folder / "estop.json").read_text("utf-8"))["by"] == "root (unverified)"
    finally:
        for folder, mode in before:
            folder.chmod(mode)
