from __future__ import annotations

import contextlib
import queue
import socket
import sys
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.errors import ConfigurationError, PolicyError, PolicyLostError, PolicyTimeout
from runtime.core.types import Observation
from runtime.policies import lerobot
from runtime.policies.lerobot import Config, LerobotPolicy
from runtime.standins.faults import NONE, Fault

pytest.importorskip("grpc", reason="the extra lerobot-grpc is not installed")
from runtime.standins.lerobot_server import LerobotBehaviour, LerobotServer

ROBOT = robots.load_robot("agilex_piper")
NOWHERE = "grpc://127.0.0.1:1"


def observation(value: float = 0.1) -> Observation:
    pictures = {camera.key: np.zeros((24, 32, 3), np.uint8) for camera in ROBOT.cameras}
    return Observation(1, 0.0, {}, np.full(ROBOT.dim, value, np.float32), pictures, prompt="pick", step=3)


def config(url: str, **settings: Any) -> Config:
    made: dict[str, Any] = {
        "policy_type": "act",
        "checkpoint": "user/ckpt",
        "images": {camera.key: camera.key for camera in ROBOT.cameras},
        "accept_pickle": True,
        **settings,
    }
    return Config(url=url, **made)


@contextlib.contextmanager
def policy_at(url: str, **settings: Any) -> Iterator[LerobotPolicy]:
    policy = lerobot.build(config(url, **settings), ROBOT, MonotonicClock(), 30.0)
    with contextlib.closing(policy):
        yield policy


@contextlib.contextmanager
def failing(
    url: str, says: str, error: type[Exception] = PolicyError, **settings: Any
) -> Iterator[LerobotPolicy]:
    """A policy of which what is done next fails."""
    with policy_at(url, **settings) as policy, pytest.raises(error, match=says):
        yield policy


@contextlib.contextmanager
def served(fault: Fault = NONE, port: int = 0, **behaviour: Any) -> Iterator[tuple[LerobotServer, str]]:
    with contextlib.closing(LerobotServer(ROBOT, LerobotBehaviour(fault=fault, **behaviour), port)) as server:
        yield server, str(server.start()["url"])


def starts_at(chunk: Any, value: float) -> bool:
    return bool(np.abs(chunk.actions[0] - np.clip(value, ROBOT.lower, ROBOT.upper)).max() < 0.05)


# Before anything is sent


def test_a_checkpoint_has_to_allow_pickles() -> None:
    with pytest.raises(ConfigurationError, match=r"exchanges pickles: .* policy.accept_pickle = true"):
        lerobot.build(config(NOWHERE, accept_pickle=False), ROBOT, MonotonicClock(), 30.0)


@pytest.mark.parametrize("host", ["10.0.0.7", "gpu-3", "[fe80::1]", "0.0.0.0"])
def test_a_server_beyond_this_machine_has_to_be_allowed(host: str) -> None:
    url = f"grpc://{host}:8080"
    with pytest.raises(ConfigurationError, match="leaves this machine over a plain link"):
        lerobot.build(config(url), ROBOT, MonotonicClock(), 30.0)
    lerobot.build(config(url, insecure_link=True), ROBOT, MonotonicClock(), 30.0).close()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "localhost", "[::1]"])
def test_this_machine_is_allowed(host: str) -> None:
    lerobot.build(config(f"grpc://{host}:8080"), ROBOT, MonotonicClock(), 30.0).close()


def test_without_grpc_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "grpc", None)
    with pytest.raises(ConfigurationError, match=r"needs the package grpcio.*eva-web\[lerobot-grpc\]"):
        lerobot.build(config(NOWHERE), ROBOT, MonotonicClock(), 30.0)


# A conversation that goes well


def test_it_answers_with_the_rows_of_its_observation() -> None:
    with served(horizon=20) as (server, url), policy_at(url, actions_per_chunk=20) as policy:
        info = policy.connect()
        for value in (0.05, 0.05, 0.3):  # the second shows hardly anything new, and has to go all the same
            chunk = policy.infer(observation(value))
            assert chunk.actions.shape == (20, ROBOT.dim)
            assert starts_at(chunk, value)
        policy.reset()
        assert starts_at(policy.infer(observation(0.2)), 0.2)
        assert server.failures == []
        assert server.loads == 1
    assert (info.name, info.horizon) == ("user/ckpt", 20)
    assert chunk.timing["round_trip_ms"] > 0


def test_pictures_that_need_several_messages_arrive_whole() -> None:
    pictures = {camera.key: np.zeros((900, 1200, 3), np.uint8) for camera in ROBOT.cameras}
    shown = Observation(1, 0.0, {}, np.zeros(ROBOT.dim, np.float32), pictures, prompt="pick")
    with served() as (server, url), policy_at(url) as policy:
        assert policy.infer(shown).actions.shape == (50, ROBOT.dim)
        assert server.failures == []


def test_rows_in_another_order_are_put_in_that_of_their_steps() -> None:
    with served() as (_, url), policy_at(url) as policy:
        expected = policy.infer(observation()).actions
    with served(Fault("shuffled")) as (_, url), policy_at(url) as policy:
        np.testing.assert_array_equal(policy.infer(observation()).actions, expected)


# Who listens there


@contextlib.contextmanager
def raw_server(answer: bytes | None) -> Iterator[str]:
    """A TCP server that answers whatever it is told with `answer`, or with silence."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        held: list[socket.socket] = []

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    peer = listener.accept()[0]
                    held.append(peer)
                    if answer is not None and peer.recv(4096):
                        peer.sendall(answer)
                        peer.shutdown(socket.SHUT_WR)

        thread = threading.Thread(target=accept)
        thread.start()
        yield f"grpc://127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()
        for peer in held:
            peer.close()


@pytest.mark.parametrize(
    "answer", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\xff\0\0\0\0\0\0\0\1\x7f", b"220 hello\r\n"]
)
def test_another_server_is_said_not_to_speak_grpc(answer: bytes) -> None:
    with raw_server(answer) as url, failing(url, "does not speak gRPC") as policy:
        policy.connect()


def test_a_port_that_hangs_up_is_lost() -> None:
    with raw_server(b"") as url, failing(url, "see that it runs, and speaks gRPC", PolicyLostError) as policy:
        policy.connect()


def test_a_grpc_server_of_another_kind_is_named() -> None:
    from concurrent.futures import ThreadPoolExecutor

    import grpc

    server = grpc.server(ThreadPoolExecutor(1))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        with failing(f"grpc://127.0.0.1:{port}", "without LeRobot's Ready") as policy:
            policy.connect()
    finally:
        server.stop(0).wait()


def test_what_the_server_cannot_load_is_its_own_sentence() -> None:
    with served(Fault("load_fails")) as (_, url), failing(url, "user/ckpt is not a folder") as policy:
        policy.connect()
    with served() as (_, url), failing(url, "Policy type dream not supported", policy_type="dream") as policy:
        policy.connect()


def test_a_server_of_another_version_is_told_by_where_its_classes_are() -> None:
    with served(Fault("no_name")) as (_, url), failing(url, r"policy\.server_version is '0\.4'") as policy:
        policy.connect()


# What goes wrong later


def test_nothing_is_asked_for_again_and_then_explained() -> None:
    with served(Fault("exception"), patience=0.1) as (server, url):
        with (
            policy_at(url, first_inference_deadline=1.0) as policy,
            pytest.raises(PolicyError, match=r"answered with nothing, \d+ times within 1 s: .*its own log"),
        ):
            policy.infer(observation())
        assert server.failures
        assert set(server.failures) == {"RuntimeError: CUDA out of memory (on purpose)"}


class Forgetful(queue.Queue[Any]):
    """Loses the first observation, as a call that was given up takes it."""

    lost = False

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        if self.lost:
            super().put(item, block, timeout)
        self.lost = True


def test_an_observation_that_was_lost_is_sent_again() -> None:
    with served(patience=0.1) as (server, url), policy_at(url) as policy:
        policy.connect()
        server._waiting = Forgetful(maxsize=1)
        assert starts_at(policy.infer(observation(0.3)), 0.3)
        assert server._waiting.lost


def test_a_late_answer_is_never_taken_for_the_next_one() -> None:
    with (
        served(Fault("late_reply", "4")) as (server, url),
        policy_at(url, inference_deadline=0.2, first_inference_deadline=20.0) as policy,
    ):
        policy.infer(observation(0.05))
        with pytest.raises(
            PolicyTimeout, match=r"did not answer GetActions within .* s; the connection is dropped"
        ):
            policy.infer(observation(0.3))
        policy._warm = False
        assert starts_at(policy.infer(observation(0.6)), 0.6)
        assert server.loads == 1  # it was not gone


def test_a_server_that_came_back_loads_the_checkpoint_again() -> None:
    with served() as (_, url), policy_at(url) as policy:
        policy.infer(observation())
        port = int(url.rpartition(":")[2])
        _.close()
        with pytest.raises(PolicyLostError):
            policy.infer(observation())
        with pytest.raises(PolicyLostError, match="no policy server listens"):
            policy.infer(observation())
        with served(port=port) as (again, _url):
            assert starts_at(policy.infer(observation(0.2)), 0.2)
            assert again.loads == 1
