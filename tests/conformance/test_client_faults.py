"""Every fault of a client against our node: it moves nothing, is refused by name, and the node goes on."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
import zmq

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.types import RobotCommand
from runtime.simulation.node import Node, parser, run
from runtime.standins import arrays
from runtime.transports import zmq as link
from runtime.transports.node_source import NodeSource
from tests.processes import eventually, joined

ROBOT = robots.load_robot("ur5e")
HOME = ROBOT.poses["home"].astype(np.float32)
AWAY = np.clip(HOME + 0.2, ROBOT.lower + 0.01, ROBOT.upper - 0.01).astype(np.float32)
FREE = ["--obs-endpoint", "tcp://127.0.0.1:0", "--action-endpoint", "tcp://127.0.0.1:0"]
CLOCK = MonotonicClock()

pytestmark = pytest.mark.usefixtures("no_thread_is_left")


class Bench:
    """A node that runs by itself, `source` that hears it, and sockets of clients."""

    def __init__(self) -> None:
        line = ["--robot", "ur5e", *FREE, "--width", "96", "--height", "60", "--deadline", "0.3"]
        self.node = Node(ROBOT, parser().parse_args(line), CLOCK)
        ready = self.node.open()
        self.endpoint = ready["action_endpoint"]
        self.paused, self._told = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=run, args=(self, CLOCK, 60.0, self._told), name="node")
        self._thread.start()
        self.config = link.Config(sub_endpoint=ready["obs_endpoint"], pub_endpoint=self.endpoint)
        self.source: NodeSource = link.source(self.config, ROBOT, CLOCK)
        self.source.connect()
        self._clients: list[zmq.Socket[bytes]] = []

    def tick(self, seconds: float) -> None:
        if not self.paused.is_set():
            self.node.tick(seconds)

    def client(self) -> zmq.Socket[bytes]:
        """As existing clients have it."""
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PUB)
        socket.connect(self.endpoint)
        self._clients.append(socket)
        return socket

    def stands(self) -> np.ndarray[Any, Any]:
        return np.asarray(self.seen().qpos)

    def seen(self) -> Any:
        return eventually(lambda: self.source.receive(0.1), "an observation: the node has ended")

    def refused(self, reason: str) -> int:
        self.seen()
        return self.source.status.refused.get(reason, 0)

    def moved_by(self, client: zmq.Socket[bytes], target: np.ndarray[Any, Any], **fields: Any) -> None:
        """The client commands until the robot is there."""

        def there() -> bool:
            client.send(command(target, **fields))
            return bool(np.abs(self.stands() - target).max() < 0.01)

        eventually(there, "the robot at its target")

    def close(self) -> None:
        self._told.set()
        joined(self._thread)
        self.source.close()
        self.node.close()
        for socket in self._clients:
            socket.close(linger=0)


@pytest.fixture
def bench() -> Iterator[Bench]:
    with contextlib.closing(Bench()) as made:
        yield made


def command(action: Any = AWAY, **fields: Any) -> bytes:
    return arrays.packed({"t": time.monotonic(), "action": action, "target": "real"} | fields)


def array_map(**fields: Any) -> dict[bytes, Any]:
    return {key.encode(): value for key, value in fields.items()}


MNP = array_map(nd=True, type="<f4", kind=b"", shape=[7], data=AWAY.tobytes())
PICKLED = array_map(__ndarray__=True, data=b"cos\nsystem\n.", dtype="|O", shape=[7])
FAULTS: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "malformed"),
    "noise": (lambda: bytes(range(200)), "malformed"),
    "truncated": (lambda: command()[:-3], "malformed"),
    "no_map": (lambda: bytes(msgpack.packb([1, 2])), "malformed"),
    "no_action": (lambda: arrays.packed({"t": 1.0}), "malformed"),
    "a_list_for_an_array": (lambda: command(AWAY.tolist()), "malformed"),
    "wrong_dtype": (lambda: command(AWAY.astype(np.int64)), "malformed"),
    "dialect_mnp": (lambda: arrays.packed({"t": 1.0, "action": MNP}), "malformed"),
    "dialect_npy": (
        lambda: arrays.packed({"t": 1.0, "action": {"__ndarray_class__": True, "as_npy": b"\x93NUMPY"}}),
        "malformed",
    ),
    "object_array": (lambda: arrays.packed({"t": 1.0, "action": PICKLED}), "malformed"),
    "two_megabytes": (lambda: command(more=b"x" * 2_000_000), "malformed"),
    "target_is_no_word": (lambda: command(target=7), "malformed"),
    "too_short": (lambda: command(AWAY[:6]), "dimension"),
    "batched": (lambda: command(AWAY[None]), "dimension"),
    "not_a_number": (lambda: command(AWAY * np.nan), "not_finite"),
    "infinite": (lambda: command(np.full(7, np.inf, np.float32)), "not_finite"),
    "beyond_limits": (lambda: command(np.full(7, 99.0, np.float32)), "limits"),
    "unknown_word": (lambda: command(target="explode"), "unknown_target"),
    "no_bench": (lambda: command(target="scene_reset", id="a", seed=1), "no_bench"),
}


@pytest.mark.some(7)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_message_moves_nothing_and_is_refused_by_name(bench: Bench, fault: str) -> None:
    payload, reason = FAULTS[fault]
    client, before = bench.client(), bench.stands()

    def refused() -> int:
        client.send(payload())
        return bench.refused(reason)

    eventually(refused, reason)
    assert set(bench.source.status.refused) == {reason}
    assert bench.source.status.holding is True
    np.testing.assert_array_equal(bench.stands(), before)
    assert f"node_refused.{reason}" in bench.source.faults()
    bench.moved_by(client, AWAY)


def test_a_client_that_dies_leaves_a_robot_that_holds(bench: Bench) -> None:
    client = bench.client()
    eventually(
        lambda: client.send(command()) or (bench.seen() and bench.source.status.holding is False),
        "motion",
    )
    client.close(linger=0)
    eventually(lambda: bench.seen() and bench.source.status.holding, "holding")
    before = bench.stands()
    np.testing.assert_array_equal(bench.stands(), before)


def test_of_two_clients_one_rules_and_the_other_is_told_whom_the_node_obeys(bench: Bench) -> None:
    first, second = bench.client(), bench.client()
    bench.moved_by(first, AWAY, master="first")

    def refused() -> int:
        first.send(command(AWAY, master="first"))
        second.send(command(HOME, master="second"))
        return bench.refused("other_master")

    eventually(refused, "other_master")
    assert np.abs(bench.stands() - AWAY).max() < 0.01
    assert bench.source.describe_fault("node_refused.other_master") == (
        "several clients command the node, which obeys first alone"
    )


def test_a_ruler_that_dies_is_followed_by_the_other(bench: Bench) -> None:
    first, second = bench.client(), bench.client()
    bench.moved_by(first, AWAY, master="first")
    first.close(linger=0)
    bench.moved_by(second, HOME, master="second")
    assert bench.source.status.master == "second"


def test_what_was_sent_while_the_node_stood_still_is_stale(bench: Bench) -> None:
    client = bench.client()
    bench.moved_by(client, AWAY)
    stood = bench.stands()
    bench.paused.set()
    while bench.source.receive(0.1) is not None:  # it stands
        pass
    for _ in range(1000):
        client.send(command(HOME))
    time.sleep(0.5)  # longer than a command may be old
    bench.paused.clear()
    eventually(lambda: bench.refused("stale"), "stale")
    np.testing.assert_allclose(bench.stands(), stood, atol=1e-3)
    bench.moved_by(client, HOME)  # what is sent now is obeyed


@pytest.mark.parametrize("jump", [-1000.0, 1000.0])
def test_a_client_whose_clock_jumps_is_obeyed(bench: Bench, jump: float) -> None:
    client = bench.client()
    bench.moved_by(client, AWAY)

    def there() -> bool:
        client.send(command(HOME, t=time.monotonic() + jump))
        return bool(np.abs(bench.stands() - HOME).max() < 0.01)

    eventually(there, "home")
    assert bench.source.status.refused == {}


def test_a_flood_of_noise_keeps_nobody_from_being_heard(bench: Bench) -> None:
    noisy, client = bench.client(), bench.client()

    def there() -> bool:
        for payload, _ in FAULTS.values():
            noisy.send(payload()[:10_000])
        client.send(command(AWAY))
        return bool(np.abs(bench.stands() - AWAY).max() < 0.01)

    eventually(there, "the robot at its target")
    assert len(bench.source.status.refused) < 8, "one name each, however many"


def test_peers_that_are_no_clients_end_nothing(bench: Bench) -> None:
    """A browser at the port, a client of another socket type, one that hangs up in mid-greeting."""
    import socket

    host, port = bench.endpoint.removeprefix("tcp://").split(":")
    for greeting in (b"GET / HTTP/1.1\r\n\r\n", b"\xff\0\0\0", b""):
        with socket.create_connection((host, int(port))) as peer:
            peer.sendall(greeting)
    with contextlib.closing(zmq.Context.instance().socket(zmq.REQ)) as other:
        other.setsockopt(zmq.LINGER, 0)
        other.connect(bench.endpoint)
        other.send(b"anybody?")
        bench.moved_by(bench.client(), AWAY)


def test_our_own_client_reads_in_the_acknowledgement_which_of_its_commands_was_obeyed(bench: Bench) -> None:
    sink = link.sink(bench.config, ROBOT, CLOCK)
    sink.connect()
    with contextlib.closing(sink):

        def acknowledged() -> int | None:
            sink.send(RobotCommand(AWAY, 0, time.monotonic()))
            bench.seen()
            return bench.source.status.ack

        first = eventually(acknowledged, "an acknowledgement")
        eventually(lambda: (acknowledged() or 0) > first, "a later one")
        assert bench.source.status.master == sink.master
