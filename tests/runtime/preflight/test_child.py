"""Preflights of a station are processes of their own: begun, ended, cancelled, remembered."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, ConnectionClosedOK
from websockets.sync.server import ServerConnection

from runtime.config import loader
from runtime.config.loader import server_address
from runtime.core import msgpack_arrays
from runtime.core.errors import RuntimeFault
from runtime.ipc.command_arguments import PreflightRequest
from runtime.policies.websocket_link import CLOSING, wait_closed
from runtime.station import preflight_child as module
from runtime.station.preflight_child import Preflights
from tests.processes import PATIENCE_S, eventually
from tests.runtime.policies.peers import FRANKA, serving
from tests.runtime.preflight.bench import WIRES, planned, served

OWN = planned(WIRES["openpi"], "ws://127.0.0.1:1").resolved
SAYS = 'import sys; sys.stdin.readline(); print(\'{"verdict": "ok"}\')'
HANGS = "import sys; sys.stdin.read()"


class Bench:
    """Preflights whose processes run a line of Python, on a clock of the test's own."""

    def __init__(self, code: str) -> None:
        self.time = 0.0
        self.preflights = Preflights(lambda: self.spawn(code), lambda: self.time)
        self.children: list[subprocess.Popen[bytes]] = []

    def spawn(self, code: str) -> subprocess.Popen[bytes]:
        child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.children.append(child)
        return child

    def start(self, id: str = "one", **asked: Any) -> None:
        self.preflights.start(PreflightRequest(id=id, **asked), OWN)

    def over(self, id: str = "one") -> dict[str, Any]:
        assert self.preflights._kept[id].over.wait(PATIENCE_S)
        return self.preflights.report(id)


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    made = Bench(getattr(request, "param", SAYS))
    yield made
    made.preflights.close()
    for child in made.children:
        assert child.wait(PATIENCE_S) is not None


def test_what_its_process_says_is_the_report(bench: Bench) -> None:
    bench.start(checkpoint={"id": 3, "name": "pi0"})
    assert bench.preflights.current == "the checkpoint pi0"
    assert bench.over() == {"running": False, "report": {"verdict": "ok"}, "failure": ""}
    ended = bench.preflights.poll()
    assert ended is not None
    assert (ended.id, ended.finished) == ("one", {"verdict": "ok"})
    assert bench.preflights.poll() is None
    assert bench.preflights.current == ""


@pytest.mark.parametrize("bench", [HANGS], indirect=True)
def test_there_is_one_at_a_time_and_the_same_asked_again_is_the_same(bench: Bench) -> None:
    bench.start()
    bench.start()
    assert len(bench.children) == 1
    with pytest.raises(RuntimeFault, match=r"preflight of the deployment's policy is under way"):
        bench.start("two")
    assert bench.preflights.report("one") == {"running": True, "report": None, "failure": ""}


@pytest.mark.parametrize("bench", [HANGS], indirect=True)
def test_one_that_outlasts_its_deadline_is_ended(bench: Bench) -> None:
    assert bench.preflights.start(PreflightRequest(id="one", deadline_s=5.0), OWN) == 185.0
    bench.time = 184.0
    assert bench.preflights.poll() is None
    assert bench.children[0].poll() is None
    bench.time = 186.0
    bench.preflights.poll()
    assert bench.over()["failure"] == "it did not end in time"


@pytest.mark.parametrize("bench", [HANGS], indirect=True)
def test_one_that_is_cancelled_says_for_what(bench: Bench) -> None:
    bench.start()
    bench.preflights.cancel("setup by ann")
    assert bench.over() == {"running": False, "report": None, "failure": "cancelled: setup by ann"}
    bench.preflights.poll()
    bench.preflights.cancel("nothing is under way")


@pytest.mark.parametrize(
    "bench", ["raise SystemExit(7)", "import sys; sys.stdin.readline(); print('[1]')"], indirect=True
)
def test_a_process_that_says_nothing_of_use_is_a_failure_with_its_code(bench: Bench) -> None:
    bench.start()
    assert "its process exited with" in bench.over()["failure"]


def test_the_oldest_reports_are_forgotten(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_KEPT", 2)
    for id in ("one", "two", "three"):
        bench.start(id)
        bench.over(id)
        assert bench.preflights.poll() is not None
    with pytest.raises(RuntimeFault, match="preflight 'one' is not known here"):
        bench.preflights.report("one")
    assert bench.preflights.report("three")["report"] == {"verdict": "ok"}


def test_a_process_that_cannot_be_started_is_the_reason() -> None:
    def full() -> subprocess.Popen[bytes]:
        raise OSError(11, "Resource temporarily unavailable")

    preflights = Preflights(full)
    with pytest.raises(RuntimeFault, match="cannot be started"):
        preflights.start(PreflightRequest(id="one"), OWN)
    assert preflights.current == ""


def test_who_waits_for_one_gets_the_report_or_why_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench("")
    monkeypatch.setattr(module, "_spawn_child", lambda: bench.spawn(SAYS))
    assert module.run_preflight({}, 30.0) == {"verdict": "ok"}
    monkeypatch.setattr(module, "_spawn_child", lambda: bench.spawn(HANGS))
    with pytest.raises(RuntimeFault, match="its process exited with -9"):
        module.run_preflight({}, 0.2)


# --- the program itself


def flown(line: dict[str, Any]) -> tuple[dict[str, Any], int]:
    done = subprocess.Popen(
        [sys.executable, "-m", "runtime.preflight", "--given"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert done.stdin is not None
    assert done.stdout is not None
    done.stdin.write(json.dumps(line).encode() + b"\n")
    done.stdin.flush()
    said = done.stdout.read()
    code = done.wait(PATIENCE_S)
    done.stdin.close()
    done.stdout.close()
    return json.loads(said), code


@pytest.mark.exhaustive
@pytest.mark.slow
def test_the_program_asks_the_policy_of_the_changes_and_says_it_in_a_line() -> None:
    with served("openpi") as url:
        report, code = flown({"tree": dict(OWN.tree), "changes": {"policy": {"url": url}}, "deadline_s": 60})
    assert (report["verdict"], code) == ("ok", 0)
    assert report["endpoint"] == url
    assert report["chunk"]["joints"] == FRANKA.dim


@pytest.mark.exhaustive
@pytest.mark.slow
def test_the_program_says_what_is_wrong_with_what_it_is_asked_and_ends_with_its_parent() -> None:
    report, code = flown({"tree": dict(OWN.tree), "changes": {"policy": {"uri": "ws://x"}}})
    assert (report["verdict"], report["stage"], code) == ("misconfigured", "resolve", 2)
    assert "uri" in report["sentence"]
    assert "the checkpoint" in report["sentence"]
    reading, writing = os.pipe()
    orphan = subprocess.Popen([sys.executable, "-m", "runtime.preflight", "--given"], stdin=reading)
    os.close(reading)
    os.close(writing)
    assert orphan.wait(PATIENCE_S) != 0


@pytest.mark.slow
def test_a_terminal_is_told_in_lines_or_in_json(tmp_path: Any, capfd: Any) -> None:
    from runtime.preflight.__main__ import main

    path = tmp_path / "mine.toml"
    path.write_text(
        'station = "s"\nrobot = "dual_franka"\ngroups = ["left_arm"]\n[transport]\nkind = "zmq"\n'
        '[policy]\nkind = "openpi"\nurl = "ws://127.0.0.1:1"\n'
    )
    assert main([str(path)]) == 1
    assert capfd.readouterr().out.startswith(
        "port_closed  at connect\nno policy server listens at ws://127.0.0.1:1"
    )
    assert main([str(path), "--set", "policy.kind=mock", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["kind"] == "mock"
    assert main([str(tmp_path / "absent.toml")]) == 2
    assert "misconfigured  at resolve" in capfd.readouterr().out
    with pytest.raises(SystemExit):
        main([])


# --- which server


@pytest.mark.parametrize(
    ("url", "server"),
    [
        ("ws://localhost:8000/a", "127.0.0.1:8000"),
        ("ws://127.0.0.1:8000", "127.0.0.1:8000"),
        ("wss://GPU-1.lab", "gpu-1.lab:443"),
        ("ws://gpu-1.lab", "gpu-1.lab:80"),
    ],
)
def test_a_server_has_one_spelling(url: str, server: str) -> None:
    assert server_address(planned(WIRES["openpi"], url).deployment) == server


def test_a_policy_without_a_server_has_none() -> None:
    changed = loader.apply_changes(OWN, {"policy": {"kind": "mock"}}, "test")
    assert server_address(changed.deployment) == ""


@pytest.mark.exhaustive
@pytest.mark.slow
def test_the_program_leaves_a_server_with_a_close_frame() -> None:
    """Else servers of openpi print a traceback for each preflight."""
    ended: list[ConnectionClosed] = []

    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_arrays.pack({"action_dim": 99}))
        try:
            connection.recv()
        except ConnectionClosed as closed:
            ended.append(closed)

    with serving(converse) as url:
        report, code = flown({"tree": dict(OWN.tree), "changes": {"policy": {"url": url}}, "deadline_s": 60})
        eventually(lambda: ended, "the end of the conversation")
    assert (report["verdict"], code) == ("wrong_action_space", 1)
    assert isinstance(ended[0], ConnectionClosedOK), ended[0]


def test_a_server_that_is_being_left_is_given_a_moment() -> None:
    told = threading.Event()
    leaving = threading.Thread(target=told.wait, args=(30,), name=CLOSING)
    leaving.start()
    threading.Timer(0.0, told.set).start()
    wait_closed(30.0)
    assert not leaving.is_alive()
