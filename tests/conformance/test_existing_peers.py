"""What existing execution nodes and their clients send and read, byte by byte, against our client and our node."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
import zmq

import robots
from runtime.core.clock import MonotonicClock, VirtualClock
from runtime.core.types import RobotCommand
from runtime.simulation.node import Node, parser
from runtime.transports import zmq as link
from runtime.transports.node_messages import MESSAGE_LIMIT, NodeMessages
from runtime.transports.node_sink import NodeSink
from tests.processes import eventually

ROBOT = robots.load_robot("agilex_piper")
PERIOD = 1 / 30
# {"t": 1.5, "action": zeros(2, "<f4"), "target": "real"}, as an existing client's own codec wrote it
COMMAND = bytes.fromhex(
    "83a174cb3ff8000000000000a6616374696f6e84c40b5f5f6e6461727261795f5fc3c40464617461c4080000000000000000"
    "c4056474797065a33c6634c40573686170659102a6746172676574a47265616c"
)
# {"t": 1.5, "action": zeros(1, "<f4"), "target": "hil_start", "mode": "relative"}
HIL_START = bytes.fromhex(
    "84a174cb3ff8000000000000a6616374696f6e84c40b5f5f6e6461727261795f5fc3c40464617461c40400000000"
    "c4056474797065a33c6634c40573686170659101a6746172676574a968696c5f7374617274a46d6f6465a872656c6174697665"
)


@contextlib.contextmanager
def heard_by(dim: int) -> Iterator[tuple[NodeSink, zmq.Socket[bytes]]]:
    """Our client of a robot with so many joints, and the socket of an existing node."""
    with contextlib.closing(zmq.Context.instance().socket(zmq.SUB)) as node:
        node.setsockopt(zmq.SUBSCRIBE, b"")
        port = node.bind_to_random_port("tcp://127.0.0.1")
        sink = NodeSink(f"tcp://127.0.0.1:{port}", SimpleNamespace(dim=dim), VirtualClock(1.5))  # type: ignore[arg-type]
        sink.connect()
        with contextlib.closing(sink):
            yield sink, node


def test_our_command_is_an_existing_clients_with_two_fields_after_it() -> None:
    with heard_by(2) as (sink, node):

        def sent() -> bytes | None:
            sink.send(RobotCommand(np.zeros(2, np.float32), 0, 1.5))
            return node.recv() if node.poll(20) else None

        payload = eventually(sent, "a command")
    assert payload[:1] == b"\x85"
    assert payload[1:].startswith(COMMAND[1:])
    assert list(msgpack.unpackb(payload)) == ["t", "action", "target", "master", "seq"]


def test_our_words_are_an_existing_clients_with_two_fields_after_them() -> None:
    with heard_by(1) as (sink, node):

        def sent() -> bytes | None:
            sink.send_control_word("hil_start", {"mode": "relative"})
            return node.recv() if node.poll(20) else None

        payload = eventually(sent, "a word")
    assert payload[:1] == b"\x86"
    assert payload[1:].startswith(HIL_START[1:])


# An existing client and our node


def array(value: Any) -> dict[bytes, Any]:
    """As the client's codec writes it."""
    return {
        b"__ndarray__": True,
        b"data": value.tobytes(),
        b"dtype": value.dtype.str,
        b"shape": list(value.shape),
    }


def read(payload: bytes) -> dict[str, Any]:
    """As the client's codec reads it: no check of anything."""

    def hook(fields: dict[Any, Any]) -> Any:
        if b"__ndarray__" in fields:
            return np.ndarray(fields[b"shape"], np.dtype(fields[b"dtype"]), buffer=fields[b"data"])
        return fields

    return dict(msgpack.unpackb(payload, object_hook=hook))


class Bench:
    """Our node without sockets, and an existing client's messages."""

    def __init__(self) -> None:
        self.clock = VirtualClock(100.0)
        line = ["--robot", "agilex_piper", "--width", "96", "--height", "60"]
        self.node = Node(ROBOT, parser().parse_args(line), self.clock)

    def tick(self, *payloads: bytes) -> dict[str, Any]:
        self.clock.advance(PERIOD)
        return read(self.node.exchange(payloads, PERIOD))

    def command(self, action: Any, target: str = "real", **fields: Any) -> bytes:
        message = {"t": self.clock.now(), "action": array(action.astype(np.float32)), "target": target}
        return bytes(msgpack.packb(message | fields))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_recorded_messages_for_a_smaller_robot_are_read_and_refused_for_their_size_alone(
    bench: Bench,
) -> None:
    said = bench.tick(COMMAND, HIL_START)
    assert said["refused"] == {"dimension": 1}
    assert said["hil_error"] == "the simulated node has no leader arm"


def test_an_existing_client_reads_every_field_of_our_observation(bench: Bench) -> None:
    said = bench.tick()
    assert type(said["t"]) is float
    assert list(said["images"]) == ["cam_high", "cam_left_wrist", "cam_right_wrist"]
    for picture in said["images"].values():
        assert (picture.dtype, picture.shape) == (np.uint8, (60, 96, 3))
        assert picture[-2, 10].argmax() == 2  # the red patch, in BGR
    assert list(said["state"]) == ["left_arm", "right_arm"]
    assert {(part.dtype.str, part.shape) for part in said["state"].values()} == {("<f4", (7,))}
    assert {(part.dtype.str, part.shape) for part in said["eef"].values()} == {("<f4", (8,))}
    assert (said["hil_supported"], said["hil_active"]) == (False, False)
    assert {"action", "action_eef", "hil_error"}.isdisjoint(said)


def test_an_existing_client_moves_it_and_a_silent_one_leaves_it_holding(bench: Bench) -> None:
    away = np.clip(ROBOT.poses["home"] + 0.2, ROBOT.lower, ROBOT.upper)
    for _ in range(60):
        said = bench.tick(bench.command(away))
    np.testing.assert_allclose(np.concatenate(list(said["state"].values())), away, atol=1e-3)
    assert (said["master"], said["refused"]) == ("anonymous", {})
    for _ in range(15):
        said = bench.tick()
    assert said["holding"] is True


def test_an_existing_client_starts_and_ends_a_collection_by_five_copies_of_its_words(bench: Bench) -> None:
    zeros = np.zeros(14)
    before = bench.tick()["state"]["left_arm"]
    said = bench.tick(*[bench.command(zeros, "collect_start")] * 5)
    assert said["action"].shape == (14,)
    assert np.abs(said["state"]["left_arm"] - before).max() < 0.05, "a word was taken for a target"
    said = bench.tick(*[bench.command(zeros, "collect_stop")] * 5)
    assert "action" not in said
    assert said["refused"] == {}


# An existing node and our client


def test_the_observation_of_an_existing_node_is_read_with_and_without_what_is_optional() -> None:
    picture = np.zeros((4, 6, 3), np.uint8)
    picture[..., 0] = 200
    pose = np.array([0.1, 0, 0.2, 1, 0, 0, 0, 0.05], np.float32)
    message: dict[str, Any] = {
        "t": time.monotonic(),
        "images": {camera.key: array(picture) for camera in ROBOT.cameras},
        "state": {group.name: array(np.arange(7, dtype=np.float32)) for group in ROBOT.groups},
    }
    reading = NodeMessages(ROBOT, "bgr", frozenset(), MESSAGE_LIMIT)
    least = reading.read(msgpack.packb(message))
    assert (least.eef, least.action, least.sequence, least.remarks) == (None, None, None, ())
    assert least.qpos.tolist() == [*range(7), *range(7)]
    assert (least.status.ack, least.status.master, least.status.holding) == (None, None, None)
    more = {
        "eef": {arm.name: array(pose) for arm in ROBOT.arms},
        "action": array(np.zeros(14, np.float32)),
        "action_eef": array(np.concatenate([pose, pose])),
        "hil_supported": True,
        "hil_active": True,
        "hil_error": "",
        "proto": 9,  # of a later version
    }
    most = reading.read(msgpack.packb(message | more))
    assert most.remarks == ()
    assert most.action is not None
    np.testing.assert_array_equal(most.eef, np.concatenate([pose, pose]))
    assert most.status.hil_active


def test_a_node_that_knows_no_poses_sends_zeros_and_those_are_left_out() -> None:
    message = {
        "t": 1.0,
        "images": {camera.key: array(np.zeros((4, 6, 3), np.uint8)) for camera in ROBOT.cameras},
        "state": {group.name: array(np.zeros(7, np.float32)) for group in ROBOT.groups},
        "eef": {arm.name: array(np.zeros(8, np.float32)) for arm in ROBOT.arms},
    }
    found = NodeMessages(ROBOT, "bgr", frozenset(), MESSAGE_LIMIT).read(msgpack.packb(message))
    assert found.eef is None
    assert [fault for fault, _ in found.remarks] == ["eef_unusable"]


def test_our_client_hears_an_existing_node_that_sends_its_cameras_apart() -> None:
    """Partial messages are for looking at; what is complete still counts."""
    picture = array(np.zeros((4, 6, 3), np.uint8))
    with contextlib.closing(zmq.Context.instance().socket(zmq.PUB)) as node:
        port = node.bind_to_random_port("tcp://127.0.0.1")
        source = link.source(link.Config(sub_endpoint=f"tcp://127.0.0.1:{port}"), ROBOT, MonotonicClock())
        source.connect()
        with contextlib.closing(source):

            def found() -> Any:
                now = time.monotonic()
                state = {group.name: array(np.zeros(7, np.float32)) for group in ROBOT.groups}
                whole = {"t": now, "images": {c.key: picture for c in ROBOT.cameras}, "state": state}
                node.send(msgpack.packb(whole))
                node.send(msgpack.packb({"t": now, "images": {"cam_high": picture}, "state": state}))
                return source.receive(0.05)

            assert set(eventually(found, "a frame").pictures) == {c.key for c in ROBOT.cameras}
            assert eventually(found, "another").qpos.shape == (14,)
