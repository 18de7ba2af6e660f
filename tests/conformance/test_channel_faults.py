"""Every fault of a script against the control channel: a sentence for who can be told, answers for everybody else."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Callable, Iterator
from typing import Any

import psutil
import pytest
import zmq

from runtime.clients.channel.message import LARGEST
from runtime.ipc.session_state import SessionState
from tests.processes import PATIENCE_MS, PATIENCE_S, eventually
from tests.runtime.clients.channel.bench import Bench, Script

MESSAGES: dict[str, tuple[list[bytes], str]] = {
    "empty": ([b""], "recv failed: "),
    "no_json": ([b"\x93NUMPY"], "recv failed: "),
    "truncated": ([b'{"cmd": "web:set'], "recv failed: "),
    "no_utf8": ([b'{"cmd": "web:\xff\xfe"}'], "recv failed: "),
    "not_finite": ([b'{"cmd": "web:start", "x": NaN}'], "NaN is no number of JSON"),
    "deep": ([b"[" * 60_000], "recv failed: "),
    "too_large": ([b'"' + b"x" * LARGEST + b'"'], "allowed: at most 65536"),
    "several_frames": ([b'{"cmd": "web:setup"}', b"{}"], "one frame of JSON, and 2 came"),
    "no_map": ([b"[]"], "message must be a JSON object"),
    "no_command": ([b"{}"], "message must carry 'cmd' or 'query'"),
    "no_prefix": ([b'{"cmd": "start"}'], "command must start with 'web:', got 'start'"),
    "wrong_type": ([b'{"cmd": ["web:start"]}'], "command must start with 'web:', got ['web:start']"),
    "unknown_verb": ([b'{"cmd": "web:dance:now"}'], "command not allowed: 'web:dance:now'"),
    "unknown_query": ([b'{"query": "moon"}'], "unknown query: 'moon'"),
    "unknown_command": ([b'{"command": "fly"}'], "unknown command 'fly'; known: setup, run, stop"),
    "wrong_since": ([b'{"query": "events", "since": -1}'], "since = -1: must be a whole number"),
    "no_result": ([b'{"query": "result"}'], "id = None: no command of that id"),
    "no_uuid": ([b'{"query": "result", "id": []}'], "id = []: must be a UUID"),
    "no_name": ([b'{"query": "status", "client": "a b"}'], "client = 'a b': must be a name"),
    "wrong_dimension": ([b'{"cmd": "web:init_move:{\\"qpos\\": [0]}"}'], "needs 14 finite numbers"),
    "infinite": ([b'{"cmd": "web:init_move:{\\"qpos\\": [1e999]}"}'], "needs 14 finite numbers"),
    "argument": ([b'{"command": "claim", "arguments": {"a": 1}}'], "claim takes no arguments; given: a"),
    "surrogates": (
        [b'{"client": "right", "command": "setup", "arguments": {"task": "\\ud800"}}'],
        "surrogates not allowed",
    ),
    "huge_number": (
        [
            b'{"client": "right", "command": "setup", "arguments": {"bench": {"seed": 99999999999999999999999999}}}'
        ],
        "cannot pack",
    ),
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    made = Bench(tmp_path_factory.mktemp("station"))
    made.reach(SessionState.IDLE)
    yield made
    made.close()


@pytest.fixture
def script(bench: Bench) -> Iterator[Script]:
    """A script that does everything right; after each test it still gets its answers, and nothing was done."""
    made = bench.script(client="right")
    yield made
    assert made.query("status")["state"] == "idle"
    assert all(thread.is_alive() for thread in bench.threads)


@pytest.mark.parametrize("fault", MESSAGES)
def test_a_faulty_message_is_answered_with_a_sentence_and_nothing_is_done(
    bench: Bench, script: Script, fault: str
) -> None:
    frames, says = MESSAGES[fault]
    for _ in range(2):
        answer = script.raw(*frames)
        assert answer["ok"] is False
        assert says in answer["error"]
        assert len(answer["error"]) < 1000


@pytest.mark.parametrize(
    "greeting", [b"", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"\xff\0\0\0\0", b"SSH-2.0-OpenSSH_9.2\r\n" * 50]
)
def test_peers_of_other_protocols_and_mute_ones_keep_nobody_waiting(
    bench: Bench, script: Script, greeting: bytes
) -> None:
    host, port = bench.channel.removeprefix("tcp://").split(":")
    with contextlib.ExitStack() as held:
        for _ in range(5):
            held.enter_context(socket.create_connection((host, int(port)))).sendall(greeting)
        assert script.query("status")["state"] == "idle"
    assert script.query("status")["state"] == "idle"


@pytest.mark.parametrize("kind", ["PUB", "SUB", "PUSH", "PAIR", "REP"])
def test_sockets_of_other_kinds_end_nothing(bench: Bench, script: Script, kind: str) -> None:
    with zmq.Context() as context, context.socket(getattr(zmq, kind)) as other:
        other.linger = 0
        other.connect(bench.channel)
        if kind in ("PUB", "PUSH"):
            with contextlib.suppress(zmq.Again):
                other.send(b'{"cmd": "web:setup"}', zmq.NOBLOCK)
        assert script.query("status")["state"] == "idle"


def test_a_peer_that_is_no_req_socket_is_answered_in_its_own_form(bench: Bench, script: Script) -> None:
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.linger = 0
        peer.connect(bench.channel)
        peer.send(b'{"query": "status"}')
        assert peer.poll(PATIENCE_MS)
        (answer,) = peer.recv_multipart()
        assert json.loads(answer)["ok"] is True


def test_a_script_that_never_reads_its_answers_is_not_kept_for(bench: Bench, script: Script) -> None:
    """10,000 answers of some kilobytes: who kept them would have grown by as much."""
    process = psutil.Process(os.getpid())
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.linger, peer.rcvhwm, peer.sndtimeo = 0, 1, 20_000
        peer.connect(bench.channel)

        def ask(count: int) -> None:
            for _ in range(count):
                peer.send_multipart([b"", b'{"query": "config"}'])

        ask(500)
        assert script.query("status")["state"] == "idle"
        before = process.memory_info().rss
        ask(10_000)
        eventually(lambda: asked(script), "an answer for somebody else", 3 * PATIENCE_S)
        assert process.memory_info().rss - before < 60e6


def asked(script: Script) -> bool:
    return bool(script.send(query="status")["ok"])


def test_scripts_that_are_gone_before_their_answer_leave_nothing_behind(
    bench: Bench, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.clients.channel.scripts.KEPT", 5)
    assert script.query("status")["state"] == "idle"
    process = psutil.Process(os.getpid())
    before = len(process.net_connections("tcp"))
    for _ in range(50):
        with zmq.Context() as context, context.socket(zmq.REQ) as gone:
            gone.linger = 0
            gone.connect(bench.channel)
            gone.send(b'{"query": "frame"}')
    assert script.query("status")["state"] == "idle"
    few = before + 20  # both ends of five, and what is being closed
    eventually(lambda: len(process.net_connections("tcp")) <= few, "their connections gone")


def test_a_flood_of_faults_from_many_keeps_nobody_from_a_stop(bench: Bench, script: Script) -> None:
    with contextlib.ExitStack() as held:
        context = held.enter_context(zmq.Context())
        noisy = [held.enter_context(context.socket(zmq.DEALER)) for _ in range(4)]
        for number in range(1200):
            peer = noisy[number % len(noisy)]
            peer.linger = 0
            if number < len(noisy):
                peer.connect(bench.channel)
            frames = list(MESSAGES.values())[number % len(MESSAGES)][0]
            peer.send_multipart([b"", *frames])
        answer = script.cmd("halt")
        assert answer["ok"] is False  # there is nothing to halt, and that is said
        assert "idle" in answer["error"]


def refused(act: Callable[[], dict[str, Any]]) -> str:
    answer = act()
    assert (answer["ok"], answer["result"]) == (False, "refused"), answer
    return str(answer["error"])


def test_of_two_operators_at_once_the_second_is_told_who_commands(bench: Bench, script: Script) -> None:
    other = bench.script(client="second")
    assert script.command("claim")["result"] == "done"
    why = refused(lambda: other.cmd("setup"))
    assert "channel:lab/right holds the lease" in why
    assert script.command("give_up")["result"] == "done"


def test_a_command_that_waited_too_long_is_stale_and_not_carried_out(
    bench: Bench, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.clients.channel.request_worker.LATE_S", -1.0)  # whoever asked has given up
    why = refused(lambda: script.cmd("setup"))
    assert why.startswith("it waited ")
    assert why.endswith(" behind others: not carried out")
