from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.errors import (
    ConfigurationError,
    ContradictionError,
    PolicyDisconnected,
    PolicyError,
    PolicyLostError,
    PolicyTimeout,
)
from runtime.core.types import Observation
from runtime.policies import gr00t
from runtime.policies.gr00t import Config, Gr00tPolicy
from runtime.policies.groot import arrays
from runtime.standins.faults import NONE, Fault
from runtime.standins.gr00t_server import Gr00tBehaviour, Gr00tServer
from tests.processes import PATIENCE_S, eventually

ROBOT = robots.load_robot("agilex_piper")
PARTS = {group.name: list(range(group.slice.start, group.slice.stop)) for group in ROBOT.groups}
FORMS = [
    ("n1.6", False, "nested"),
    ("n1.7", False, "nested"),
    ("n1.6", True, "sim_wrapper"),
    ("n1.7", True, "sim_wrapper"),
    ("n1.5", False, "n1.5"),
]


def observation(value: float = 0.1) -> Observation:
    pictures = {camera.key: np.zeros((24, 32, 3), np.uint8) for camera in ROBOT.cameras}
    return Observation(1, 0.0, {}, np.full(ROBOT.dim, value, np.float32), pictures, prompt="pick", step=3)


def config(url: str, **settings: Any) -> Config:
    cameras = {camera.key: camera.key for camera in ROBOT.cameras}
    maps: dict[str, Any] = {"video": cameras, "state": PARTS, "actions": PARTS}
    return Config(url=url, **{**maps, "inference_deadline": 5.0, **settings})


@contextlib.contextmanager
def policy_at(url: str, **settings: Any) -> Iterator[Gr00tPolicy]:
    policy = gr00t.build(config(url, **settings), ROBOT, MonotonicClock(), ROBOT.control_rate)
    with contextlib.closing(policy):
        yield policy


@contextlib.contextmanager
def failing(
    url: str, says: str, error: type[Exception] = PolicyError, **settings: Any
) -> Iterator[Gr00tPolicy]:
    """A policy of which what is done next fails."""
    with policy_at(url, **settings) as policy, pytest.raises(error, match=says):
        yield policy


@contextlib.contextmanager
def served(fault: Fault = NONE, **behaviour: Any) -> Iterator[tuple[Gr00tServer, str]]:
    with contextlib.closing(Gr00tServer(ROBOT, Gr00tBehaviour(fault=fault, **behaviour))) as server:
        yield server, str(server.start()["url"])


@contextlib.contextmanager
def stub(answer: Callable[[dict[str, Any]], bytes], kind: int = zmq.REP) -> Iterator[str]:
    """A ZMQ server that says what a test wants."""
    wire: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    wire.setsockopt(zmq.LINGER, 0)
    port = wire.bind_to_random_port("tcp://127.0.0.1")
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            if kind == zmq.REP and wire.poll(20):
                wire.send(answer(msgpack.unpackb(wire.recv())))
        wire.close(linger=0)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{port}"
    finally:
        ended.set()
        thread.join()


@contextlib.contextmanager
def raw_server(answer: bytes, end: bool = True) -> Iterator[str]:
    """A TCP server that says `answer` to whoever has said something."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        held: list[socket.socket] = []

        def accept() -> None:
            peer = listener.accept()[0]
            held.append(peer)
            peer.recv(4096)
            peer.sendall(answer)
            if end:
                peer.shutdown(socket.SHUT_WR)

        thread = threading.Thread(target=accept)
        thread.start()
        yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        thread.join()
        for peer in held:
            peer.close()


# A conversation that goes well


@pytest.mark.parametrize(("version", "flat", "dialect"), FORMS)
def test_every_version_answers_with_the_rows_of_its_observation(
    version: str, flat: bool, dialect: str
) -> None:
    with served(version=version, flat=flat, horizon=20) as (server, url):
        with policy_at(url, dialect=dialect) as policy:
            info = policy.connect()
            for value in (0.05, 0.3):
                chunk = policy.infer(observation(value))
                assert chunk.actions.shape == (20, ROBOT.dim)
                near = np.clip(value, ROBOT.lower, ROBOT.upper)
                assert np.abs(chunk.actions[0] - near).max() < 0.05
            policy.reset()
            policy.infer(observation())
        assert server.failures == []
    assert info.horizon == 20
    assert info.metadata["modality"]["language"]["keys"] == ["annotation.human.task_description"]
    assert chunk.timing["round_trip_ms"] > 0


def test_nothing_but_what_it_needs_is_asked_of_the_server() -> None:
    endpoints: list[str] = []

    def answer(message: dict[str, Any]) -> bytes:
        endpoints.append(message["endpoint"])
        return bytes(msgpack.packb({"error": "no"}))

    with stub(answer) as url, policy_at(url) as policy:
        for act in (policy.connect, lambda: policy.infer(observation())):
            with pytest.raises(PolicyError, match="reports an error: no"):
                act()
        policy.reset()
    assert endpoints == ["get_modality_config"] * 2


def test_a_server_that_knows_no_reset_has_nothing_to_forget() -> None:
    with served() as (server, url), policy_at(url) as policy:
        policy.infer(observation())
        server._behaviour = Gr00tBehaviour(fault=Fault("unknown_endpoint"))
        policy.reset()
        with pytest.raises(PolicyError, match="has no endpoint 'get_action'"):
            policy.infer(observation())


def test_it_sends_the_token_that_the_environment_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LAB_TOKEN", "secret")
    with served(token="secret") as (_, url):
        with policy_at(url, api_token_env="LAB_TOKEN") as policy:
            assert policy.infer(observation()).actions.shape == (50, 14)
        with policy_at(url) as policy, pytest.raises(PolicyError, match="none was given"):
            policy.connect()
    with (
        served(token="another") as (_, url),
        failing(
            url, r"wants an API token, a wrong one .* policy.api_token_env", api_token_env="LAB_TOKEN"
        ) as policy,
    ):
        policy.connect()


def test_a_token_that_is_not_in_the_environment_is_found_at_once() -> None:
    with (
        pytest.raises(ConfigurationError, match=r"LAB_MISSING, which is not set"),
        policy_at("tcp://127.0.0.1:1", api_token_env="LAB_MISSING"),
    ):
        pass


# Who listens there


def test_another_server_is_named_by_what_it_says() -> None:
    with (
        raw_server(b"HTTP/1.1 400 Bad Request\r\n\r\n") as url,
        failing(url, r"does not speak ZMQ .*400 Bad Request") as policy,
    ):
        policy.connect()


def test_a_port_that_hangs_up_is_lost() -> None:
    with raw_server(b"") as url, failing(url, "closed the connection at once", PolicyLostError) as policy:
        policy.connect()


def test_a_server_that_went_between_two_requests_is_lost() -> None:
    """ZMQ has nobody to send to then, which it says in a word of its own."""
    with served() as (server, url), policy_at(url) as policy:
        policy.connect()
        policy.infer(observation())
        server.close()
        assert policy._link._socket is not None
        wire = policy._link._socket
        eventually(lambda: not wire.poll(0, zmq.POLLOUT), "the end of the connection")
        with pytest.raises(PolicyDisconnected, match="since the last request"):
            policy.infer(observation())
        with pytest.raises(PolicyLostError, match="no policy server listens"):
            policy.infer(observation())


def test_a_greeting_without_a_handshake_times_out() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        held = []

        def accept() -> None:
            for _ in range(2):
                peer = listener.accept()[0]
                peer.sendall(b"\xff\0\0\0\0\0\0\0\1\x7f")
                held.append(peer)

        thread = threading.Thread(target=accept)
        thread.start()
        with failing(
            f"tcp://127.0.0.1:{listener.getsockname()[1]}",
            "no ZMQ handshake within 0.6 s",
            PolicyTimeout,
            connect_deadline=0.6,
        ) as policy:
            policy.connect()
        thread.join()
        for peer in held:
            peer.close()


@pytest.mark.parametrize("kind", [zmq.PUB, zmq.SUB, zmq.PULL])
def test_the_port_of_an_execution_node_is_told_from_a_policy_servers(kind: int) -> None:
    with stub(lambda message: b"", kind) as url, failing(url, "speaks ZMQ but takes no requests") as policy:
        policy.connect()


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        (b"\x80", "answer to get_modality_config is dict"),
        (b"", "not the GR00T protocol"),
        (b"ERROR", "answers get_modality_config with ERROR"),
        (msgpack.packb({"status": "ok"}), "expected a map of video"),
    ],
)
def test_a_rep_server_of_another_protocol_is_named(reply: bytes, says: str) -> None:
    with stub(lambda message: reply) as url, failing(url, says) as policy:
        policy.connect()


def test_servers_of_another_version_contradict_the_configuration() -> None:
    with (
        served(version="n1.5") as (_, url),
        failing(url, "of version N1.5, policy.dialect = 'nested'", ContradictionError) as policy,
    ):
        policy.connect()
    with served(seen=(-2, 0)) as (_, url), failing(url, "policy.history", ContradictionError) as policy:
        policy.connect()


def test_requests_in_the_wrong_form_are_told_with_the_right_one() -> None:
    with (
        served() as (_, url),
        failing(url, r'another form: .*see policy.dialect = "nested"', dialect="sim_wrapper") as policy,
    ):
        policy.infer(observation())
    with served(flat=True) as (_, url), failing(url, r'another form: .*"sim_wrapper"') as policy:
        policy.infer(observation())


def test_a_model_that_sees_the_past_is_shown_it() -> None:
    with served(seen=(-2, 0)) as (server, url), policy_at(url, history="nearest") as policy:
        policy.infer(observation())
        video = server.requests[-1]["data"]["observation"]["video"]
    assert video["cam_high"].shape == (1, 2, 24, 32, 3)


# What goes wrong later


def test_a_late_answer_is_never_taken_for_the_next_one() -> None:
    with (
        served(Fault("late_reply", "4")) as (_, url),
        policy_at(url, inference_deadline=0.2, first_inference_deadline=20.0) as policy,
    ):
        policy.infer(observation(0.05))
        with pytest.raises(PolicyTimeout, match=r"within 0\.2 s; the connection is dropped"):
            policy.infer(observation(0.3))
        policy._warm = False
        chunk = policy.infer(observation(0.6))
    assert np.abs(chunk.actions[0] - np.clip(0.6, ROBOT.lower, ROBOT.upper)).max() < 0.05


@contextlib.contextmanager
def vacant(url: str) -> Iterator[None]:
    """Nobody listens there, and nobody else's server comes to: the port is taken and mute."""
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                taken.bind(("127.0.0.1", int(url.rpartition(":")[2])))
            except OSError:  # the server's own socket is closed by a thread of ZMQ, a moment after
                assert time.monotonic() < deadline
                time.sleep(0.01)
            else:
                break
        yield


def test_a_server_that_goes_away_is_noticed_before_the_deadline_and_found_again() -> None:
    with served(Fault("close_mid_reply", "1")) as (_, url), policy_at(url, inference_deadline=60.0) as policy:
        policy.infer(observation())
        with pytest.raises(PolicyLostError, match="closed the connection before an answer"):
            policy.infer(observation())
    with (
        vacant(url),
        policy_at(url) as policy,
        pytest.raises(PolicyLostError, match="no policy server listens"),
    ):
        policy.connect()


def test_an_answer_of_two_frames_is_no_gr00t_server() -> None:
    with served(Fault("two_frames")) as (_, url), failing(url, "2 frames") as policy:
        policy.infer(observation())


def test_after_an_error_the_same_connection_goes_on() -> None:
    with served(Fault("exception")) as (server, url), failing(url, "CUDA out of memory") as policy:
        policy.infer(observation())
        link = policy._link._socket
        server._behaviour = Gr00tBehaviour()
        policy.infer(observation())
        assert policy._link._socket is link


@pytest.mark.parametrize("when", ["at once", "with the next"])
def test_an_answer_that_comes_twice_is_thrown_away(when: str) -> None:
    """What stands before the server sends each answer once more; a REP socket gives the request's number back."""
    server, ended = Gr00tServer(ROBOT, Gr00tBehaviour(horizon=20)), threading.Event()
    wire: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.ROUTER)
    port = wire.bind_to_random_port("tcp://127.0.0.1")

    def repeat() -> None:
        before: list[bytes] = []
        while not ended.is_set():
            if not wire.poll(20):
                continue
            *envelope, payload = wire.recv_multipart()
            if before and when == "with the next":
                wire.send_multipart(before)
            answer = server._replies(payload)
            assert answer is not None
            before = [*envelope, *answer]
            wire.send_multipart(before)
            if when == "at once":
                wire.send_multipart(before)

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        with policy_at(f"tcp://127.0.0.1:{port}") as policy:
            for value in (0.1, 0.2, 0.3, 0.4):
                first = policy.infer(observation(value)).actions[0]
                near = np.clip(value, ROBOT.lower, ROBOT.upper)
                assert np.abs(first - near).max() < 0.05
    finally:
        ended.set()
        thread.join()
        wire.close(linger=0)


# Servers that do not say which arrays they read


def _unmarked(reads_npy: bool, asked: list[str]) -> Callable[[dict[str, Any]], bytes]:
    """A server of N1.7's answers without its mark, whose errors are those of a real one."""
    names = {"video": [camera.key for camera in ROBOT.cameras], "state": list(PARTS), "action": list(PARTS)}
    modality = {
        name: {"as_json": {"delta_indices": [0], "modality_keys": keys}}
        for name, keys in (*names.items(), ("language", ["task"]))
    }

    def answer(message: dict[str, Any]) -> bytes:
        if message["endpoint"] == "get_modality_config":
            return arrays.pack(modality)
        state = next(iter(message["data"]["observation"]["state"].values()))
        asked.append("MNP" if b"nd" in state else "NPY")
        if asked[-1] != ("NPY" if reads_npy else "MNP"):
            return arrays.pack({"error": "State key 'arm' must be a numpy array, got dict"})
        rows = {name: np.zeros((1, 1, len(part)), np.float32) for name, part in PARTS.items()}
        return arrays.pack([rows, {}], True)

    return answer


@pytest.mark.parametrize(
    ("reads_npy", "forms"), [(True, ["NPY", "NPY"]), (False, ["NPY", "MNP", "MNP"])], ids=["NPY", "MNP"]
)
def test_a_server_that_does_not_say_how_it_reads_arrays_is_asked_once_in_the_other_form(
    reads_npy: bool, forms: list[str]
) -> None:
    asked: list[str] = []
    with stub(_unmarked(reads_npy, asked)) as url, policy_at(url, dialect="nested") as policy:
        policy.connect()
        for _ in range(2):
            assert policy.infer(observation()).actions.shape == (1, ROBOT.dim)
    assert asked == forms


def test_where_neither_form_is_read_the_first_error_is_said_and_nothing_is_tried_again() -> None:
    asked: list[str] = []
    says = _unmarked(True, asked)

    def neither(message: dict[str, Any]) -> bytes:
        says(message)
        if message["endpoint"] == "get_modality_config":
            return says(message)
        return arrays.pack({"error": f"error {len(asked)}"})

    with stub(neither) as url, policy_at(url, dialect="nested") as policy:
        policy.connect()
        for sentence in ("error 1", "error 3"):
            with pytest.raises(PolicyError, match=sentence):
                policy.infer(observation())
    assert asked == ["NPY", "MNP", "NPY"]
