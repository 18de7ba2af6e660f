"""A stop over a connection of its own: after its socket, past strangers, and with a sentence where nobody listens."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from runtime.core.errors import TransportError
from runtime.ipc import bus
from runtime.ipc.bus import CommandServer, Endpoints
from runtime.ipc.endpoints import account_name
from runtime.ipc.estop_client import NoAnswer, NotSent, send_urgent
from runtime.ipc.messages import Ack, Command

PRESS = Command("u", "estop", {"why": "smoke"})
GUARD = ("guard", "estop")


class Answering:
    """A guard of its own thread, which listens anew where its socket is gone; `deaf` while it answers nothing."""

    def __init__(self, context: zmq.Context[Any], folder: Path) -> None:
        self.server, self.endpoints = CommandServer(context, folder, "estop"), Endpoints(folder)
        self.pressed: list[str] = []
        self.deaf, self._over = False, threading.Event()
        self._tell()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _tell(self) -> None:
        self.endpoints.write("guard", {"estop": self.server.endpoint})

    def _serve(self) -> None:
        while not self._over.is_set():
            self.server.socket.poll(5)
            while (asked := self.server.receive()) is not None:
                self.pressed.append(asked[1].uuid)
                if not self.deaf:
                    self.server.answer(asked[0], Ack(asked[1].uuid, "done"))
            if self.server.rebind_if_unreachable():
                self._tell()

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.server.close()


@pytest.fixture
def folder(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    session = tmp_path_factory.mktemp("r")
    session.chmod(0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(session))
    monkeypatch.setenv("HOME", str(tmp_path_factory.mktemp("h")))
    return tmp_path / "bench"


@pytest.fixture
def context() -> Iterator[zmq.Context[Any]]:
    made: zmq.Context[Any] = zmq.Context()
    yield made
    made.destroy(linger=0)


@pytest.fixture
def guard(context: zmq.Context[Any], folder: Path) -> Iterator[Answering]:
    made = Answering(context, folder)
    yield made
    made.close()


def session_of(guard: Answering) -> Path:
    return Path(guard.server.endpoint.removeprefix("ipc://")).parents[2]


@pytest.mark.parametrize("what", ["another mode", "gone", "gone with its session", "open to others"])
def test_a_press_reaches_a_station_whose_folder_changes_while_it_runs(
    guard: Answering, context: zmq.Context[Any], what: str
) -> None:
    session = session_of(guard)
    if what == "another mode":
        session.chmod(0o777)
        (session / "eva-web").rename(session / "away")
    elif what == "gone":
        (session / "eva-web").rename(session / "away")
    elif what == "gone with its session":
        session.rename(session.with_name(f"{session.name}-away"))
    else:
        next((session / "eva-web").iterdir()).chmod(0o777)
    assert send_urgent(context, guard.endpoints, GUARD, PRESS, 30.0).status == "done"
    assert "u" in guard.pressed


@pytest.mark.parametrize("what", ["no folder", "no file", "garbage", "nothing of it"])
def test_a_press_waits_for_the_file_that_says_where_as_long_as_the_socket_is_there(
    guard: Answering, context: zmq.Context[Any], folder: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = folder / "endpoints" / "guard.json"
    if what in ("no folder", "no file"):
        file.unlink()
        if what == "no folder":
            file.parent.rmdir()
    else:
        file.write_text("garbage" if what == "garbage" else "{}")
    endpoints, read = Endpoints(folder), Endpoints.read

    def missed_once(self: Endpoints, process: str) -> dict[str, Any]:
        try:
            return read(self, process)
        finally:
            guard._tell()  # as the guard does within its next looks

    monkeypatch.setattr(Endpoints, "read", missed_once)
    assert send_urgent(context, endpoints, GUARD, PRESS, 30.0).status == "done"
    assert guard.pressed == ["u"]


def test_where_nobody_listens_it_is_said_that_nothing_was_sent_and_what_to_do(
    context: zmq.Context[Any], folder: Path
) -> None:
    endpoints = Endpoints(folder)
    with pytest.raises(TransportError, match="'bench' is not running here"):
        send_urgent(context, endpoints, GUARD, PRESS, 0.1)
    endpoints.write("guard", {"estop": f"ipc://{folder}/nobody"})
    with pytest.raises(
        NotSent,
        match=r"estop was not sent: .*: no process listens there .*: press again; else start it again",
    ):
        send_urgent(context, endpoints, GUARD, PRESS, 0.1)


def test_a_guard_that_does_not_answer_is_an_unknown_outcome(
    guard: Answering, context: zmq.Context[Any]
) -> None:
    guard.deaf = True
    with pytest.raises(NoAnswer, match=r"no answer to estop within 0.1 s: outcome unknown$"):
        send_urgent(context, guard.endpoints, GUARD, PRESS, 0.1)


def test_the_answer_of_another_account_is_no_acknowledgement(
    guard: Answering, context: zmq.Context[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus, "_peer", lambda frame: (4711, 99))
    with pytest.raises(
        NoAnswer, match=rf"the process 99 of {account_name(4711)} answers at ipc://.*: not believed"
    ):
        send_urgent(context, guard.endpoints, GUARD, PRESS, 0.5)
    assert guard.pressed == ["u"], "it was sent there all the same"
