from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zmq

import robots
from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock, VirtualClock
from runtime.core.errors import ConfigurationError, TransportError
from runtime.core.node_sockets import is_loopback
from runtime.core.types import Observation, RobotCommand
from runtime.transports import node_link, node_source
from runtime.transports import zmq as link
from runtime.transports.node_sink import NodeSink
from runtime.transports.node_source import NodeSource
from runtime.transports.zmq import Config
from tests.processes import PATIENCE_S, eventually

ROBOT = robots.load_robot("agilex_piper")
CAMERAS = tuple(camera.key for camera in ROBOT.cameras)


class Node:
    """An execution node's two sockets in the hands of a test, with libzmq's defaults as real nodes have."""

    def __init__(self, obs: str = "tcp://127.0.0.1:0", act: str = "tcp://127.0.0.1:0") -> None:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self.publisher = context.socket(zmq.PUB)
        self.subscriber = context.socket(zmq.SUB)
        self.subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        self.obs = _bind(self.publisher, obs)
        self.act = _bind(self.subscriber, act)

    def say(self, payload: bytes) -> None:
        self.publisher.send(payload)

    def hear(self, patience: float = PATIENCE_S) -> dict[str, Any] | None:
        if not self.subscriber.poll(int(patience * 1e3)):
            return None
        return dict(msgpack_arrays.unpack(self.subscriber.recv()))

    def close(self) -> None:
        self.publisher.close(linger=0)
        self.subscriber.close(linger=0)


def _bind(socket: zmq.Socket[bytes], endpoint: str) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            socket.bind(endpoint)
        except zmq.ZMQError:  # the address of a node that was closed a moment ago
            assert time.monotonic() < deadline
        else:
            raw = socket.getsockopt(zmq.LAST_ENDPOINT)
            assert isinstance(raw, bytes)
            return raw.rstrip(b"\0").decode()


@pytest.fixture
def node() -> Iterator[Node]:
    with contextlib.closing(Node()) as made:
        yield made


@contextlib.contextmanager
def listening(node: Node, **settings: Any) -> Iterator[NodeSource]:
    source = link.source(Config(sub_endpoint=node.obs, **settings), ROBOT, MonotonicClock())
    source.connect()
    with contextlib.closing(source):
        yield source


@contextlib.contextmanager
def commanding(node: Node) -> Iterator[NodeSink]:
    sink = link.sink(Config(pub_endpoint=node.act), ROBOT, MonotonicClock())
    sink.connect()
    with contextlib.closing(sink):
        yield sink


def frame(t: float, mark: int = 0, /, **changes: Any) -> bytes:
    """A whole message whose pictures' first channel on the wire and whose first joint carry `mark`."""
    picture = np.zeros((6, 8, 3), np.uint8)
    picture[..., 0] = mark % 256
    picture[..., 2] = 99
    message: dict[str, Any] = {
        "t": t,
        "images": dict.fromkeys(CAMERAS, picture),
        "state": {"left_arm": np.full(7, mark, np.float32), "right_arm": np.zeros(7, np.float32)},
        "hil_supported": False,
        "hil_active": False,
    }
    return msgpack_arrays.pack({key: value for key, value in (message | changes).items() if value is not ...})


def until_heard(node: Node, source: NodeSource, payload: Callable[[], bytes]) -> Observation:
    """Publish until the subscription has reached the node and a frame comes through."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        node.say(payload())
        observation = source.receive(0.05)
        if observation is not None:
            return observation
    raise AssertionError("no frame came through")


def joined(node: Node, source: NodeSource) -> None:
    """The link is up and nothing is on its way any more."""
    until_heard(node, source, lambda: frame(time.monotonic()))
    while source.receive(0.2) is not None:
        pass


def wait_for(condition: Callable[[], bool]) -> None:
    eventually(condition, "what the wire does")


# Configuration


@pytest.mark.parametrize(
    "endpoint",
    ["tcp://192.168.1.5:5555", "tcp://robot:5555", "tcp://0.0.0.0:5555", "tcp://[2001:db8::1]:5555"],
)
@pytest.mark.parametrize("key", ["sub_endpoint", "pub_endpoint"])
def test_a_plain_link_beyond_this_machine_must_be_asked_for(key: str, endpoint: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"transport\.{key} .* insecure_link = true"):
        Config(**{key: endpoint})  # type: ignore[arg-type]
    assert getattr(Config(**{key: endpoint}, insecure_link=True), key) == endpoint  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "endpoint",
    ["tcp://127.0.0.1:1", "tcp://127.8.0.1:1", "tcp://localhost:1", "tcp://[::1]:1", "ipc:///tmp/x"],
)
def test_addresses_of_this_machine_are_loopback(endpoint: str) -> None:
    assert is_loopback(endpoint)


@pytest.mark.parametrize(
    "endpoint", ["tcp://127.0.0.1:99999", "tcp://127.0.0.1:0", "tcp://127.0.0.1", "tcp://127.0.0.1:x"]
)
def test_an_impossible_port_is_refused_because_libzmq_would_wait_for_it_for_ever(endpoint: str) -> None:
    with pytest.raises(ConfigurationError, match=r"transport.sub_endpoint .* port from 1 to 65535"):
        Config(sub_endpoint=endpoint)


def test_a_source_address_does_not_pass_for_the_destination() -> None:
    assert not is_loopback("tcp://127.0.0.1:0;192.168.1.5:5555")


def test_a_disabled_camera_must_exist() -> None:
    with pytest.raises(
        ConfigurationError, match=r"\['cam_low'\] are no cameras of agilex_piper; allowed: cam_high"
    ):
        link.source(Config(disabled_cameras=["cam_low"]), ROBOT, MonotonicClock())


def test_it_moves_a_robot() -> None:
    assert link.capabilities(Config()).moves_robot
    assert not link.capabilities(Config()).is_finite


# Observations


def test_a_frame_arrives_as_rgb_with_all_its_streams(node: Node) -> None:
    with listening(node) as source:
        observation = until_heard(node, source, lambda: frame(time.monotonic(), 7))
    assert list(observation.pictures) == list(CAMERAS)
    assert observation.pictures["cam_high"][0, 0].tolist() == [99, 0, 7]  # BGR on the wire
    assert observation.pictures["cam_high"].flags.c_contiguous
    assert not observation.pictures["cam_high"].flags.writeable
    assert observation.qpos.tolist() == [7.0] * 7 + [0.0] * 7
    assert set(observation.captured) == {"joints", *CAMERAS}
    assert observation.captured["joints"] <= observation.arrived
    assert observation.eef is None
    assert observation.reported_action is None


def test_the_encoding_on_the_wire_wins_over_the_configured_one(node: Node) -> None:
    with listening(node, encoding="rgb") as source:
        observation = until_heard(node, source, lambda: frame(time.monotonic(), 7))
        assert observation.pictures["cam_high"][0, 0].tolist() == [7, 0, 99]
        joined(node, source)
        observation = until_heard(node, source, lambda: frame(time.monotonic(), 8, encoding="bgr"))
        assert observation.pictures["cam_high"][0, 0].tolist() == [99, 0, 8]


def test_poses_and_the_reported_action_are_carried(node: Node) -> None:
    pose = np.array([0.1, 0.2, 0.3, 1, 0, 0, 0, 0.05], np.float32)
    action = np.arange(14, dtype=np.float32)
    extras: dict[str, Any] = {
        "eef": {"left_arm": pose, "right_arm": pose},
        "action": action,
        "action_eef": np.concatenate([pose, pose]),
    }
    with listening(node) as source:
        observation = until_heard(node, source, lambda: frame(time.monotonic(), **extras))
    assert observation.eef is not None
    assert observation.reported_action_eef is not None
    np.testing.assert_array_equal(observation.eef, np.concatenate([pose, pose]))
    np.testing.assert_array_equal(observation.reported_action, action)
    np.testing.assert_array_equal(observation.reported_action_eef, np.concatenate([pose, pose]))
    assert "eef" in observation.captured


def test_a_frame_is_delivered_once_and_numbers_grow(node: Node) -> None:
    with listening(node) as source:
        joined(node, source)
        assert source.receive(0.0) is None
        numbers = [until_heard(node, source, lambda: frame(time.monotonic())).sequence for _ in range(3)]
    assert numbers == sorted(set(numbers))


def test_a_disabled_camera_is_neither_needed_nor_delivered(node: Node) -> None:
    images = {key: np.zeros((6, 8, 3), np.uint8) for key in CAMERAS[:2]}
    with listening(node, disabled_cameras=["cam_right_wrist"]) as source:
        observation = until_heard(node, source, lambda: frame(time.monotonic(), images=images))
    assert list(observation.pictures) == ["cam_high", "cam_left_wrist"]


def test_a_thousand_frames_that_queued_while_nobody_read_give_the_newest_one(node: Node) -> None:
    picture = np.zeros((120, 160, 3), np.uint8)
    with listening(node) as source:
        joined(node, source)
        for number in range(1000):
            node.say(frame(time.monotonic(), number, images=dict.fromkeys(CAMERAS, picture)))

        def ended() -> bool:  # said again, because a full queue of the publisher drops the newest
            node.say(frame(time.monotonic(), 1000, master="end"))
            return source.status.master == "end"

        wait_for(ended)
        first = source.receive(PATIENCE_S)
        assert first is not None
        assert first.qpos[0] == 1000
        assert first.arrived - first.captured["joints"] < 5


def test_the_newest_counts_by_arrival_when_a_node_restarts_with_a_smaller_clock() -> None:
    first = Node()
    with listening(first) as source:
        until_heard(first, source, lambda: frame(5000.0 + time.monotonic(), 1))
        endpoints = first.obs, first.act
        first.close()
        with contextlib.closing(Node(*endpoints)) as second:
            while True:
                observation = until_heard(second, source, lambda: frame(time.monotonic() % 100, 2))
                if observation.qpos[0] == 2:
                    break
            assert source.faults()["clock_backwards"] == 1
            assert source.describe_fault("clock_backwards").startswith("the node's clock went back")
            assert abs(observation.captured["joints"] - observation.arrived) < 5
            observation = until_heard(second, source, lambda: frame(time.monotonic() % 100, 3))
    assert observation.qpos[0] in (2, 3)
    assert observation.captured["joints"] <= observation.arrived


def test_stamps_that_run_backwards_are_named_and_never_recorded_as_time(node: Node) -> None:
    """Each a little before the last: none by so much that the node's clock was set."""
    with listening(node) as source:
        joined(node, source)
        begun, times = time.monotonic(), []
        for mark in range(40):
            node.say(frame(begun - 0.02 * mark, mark))
            observation = source.receive(0.05)
            if observation is not None:
                times.append(observation.captured["joints"])

        def told() -> bool:
            return source.faults().get("not_newer", 0) >= 20

        wait_for(told)
    assert times == sorted(times)
    assert len(times) <= 20
    assert source.describe_fault("not_newer").startswith("its stamps run backwards")


@pytest.mark.parametrize(
    ("jump", "name"), [(1e6, "clock_forwards"), (0.9, "clock_forwards"), (-0.3, "clock_backwards")]
)
def test_a_jump_of_the_nodes_clock_is_named_and_ages_nothing(node: Node, jump: float, name: str) -> None:
    offset = 0.0
    with listening(node) as source:
        joined(node, source)
        for offset in (0.0, jump):
            for mark in range(3):
                node.say(frame(time.monotonic() + offset, mark))
                observation = source.receive(PATIENCE_S)
                assert observation is not None
                assert 0 <= observation.arrived - observation.captured["joints"] < 0.25
        assert source.faults() == {name: 1}
        assert "the node's clock" in source.describe_fault(name)


def test_why_no_frame_comes_is_said_once_for_each_reason(node: Node) -> None:
    with listening(node, stalled_after_s=0.05) as source:
        told: list[str] = []

        def news() -> bool:
            told.extend(event.text for event in source.pop_events())
            return bool(told)

        wait_for(news)
        assert re.fullmatch(
            rf"waiting for the node at {node.obs}: no message for [\d.]+ s: check that it runs, and that it "
            "publishes where transport.sub_endpoint says",
            told.pop(),
        )
        assert source.pop_events() == []
        until_heard(node, source, lambda: frame(time.monotonic()))
        wait_for(news)
        assert "s: it has stopped, or the way to it is cut" in told.pop()

        def unusable() -> bool:
            node.say(frame(time.monotonic(), images={}))
            return news()

        wait_for(unusable)
        assert "usable for" in told[0]
        assert told.pop().endswith("images lack cam_high, cam_left_wrist, cam_right_wrist; they have none")
        until_heard(node, source, lambda: frame(time.monotonic()))
        wait_for(news)
        assert "it has stopped" in told.pop()


FAULTS: list[tuple[str, dict[str, Any], str]] = [
    ("malformed", {"t": ...}, "t is None"),
    ("malformed", {"t": float("nan")}, "t is nan"),
    ("malformed", {"t": "now"}, "t is 'now'"),
    ("malformed", {"state": ...}, "state is a NoneType"),
    ("malformed", {"images": [1]}, "images is a list"),
    ("missing_group", {"state": {"left_arm": np.zeros(7, np.float32)}}, "state lacks right_arm"),
    (
        "wrong_dimension",
        {"state": {"left_arm": np.zeros(6, np.float32), "right_arm": np.zeros(7, np.float32)}},
        r"state.left_arm has shape \[6\]; expected \[7\]",
    ),
    (
        "wrong_dtype",
        {"state": {"left_arm": np.zeros(7, np.int32), "right_arm": np.zeros(7, np.float32)}},
        "state.left_arm is <i4",
    ),
    (
        "not_finite",
        {"state": {"left_arm": np.full(7, np.nan, np.float32), "right_arm": np.zeros(7, np.float32)}},
        "state.left_arm has",
    ),
    ("missing_camera", {"images": {"cam_high": np.zeros((6, 8, 3), np.uint8)}}, "images lack cam_left_wrist"),
    (
        "wrong_dtype",
        {"images": dict.fromkeys(CAMERAS, np.zeros((6, 8, 3), np.float32))},
        "images.cam_high is <f4",
    ),
    ("wrong_dimension", {"images": dict.fromkeys(CAMERAS, np.zeros((3, 6, 8), np.uint8))}, r"\[3, 6, 8\]"),
    ("wrong_dimension", {"images": dict.fromkeys(CAMERAS, np.zeros((0, 8, 3), np.uint8))}, r"\[0, 8, 3\]"),
    ("unknown_encoding", {"encoding": "yuv"}, "'yuv'; allowed: 'bgr', 'rgb'"),
]


@pytest.mark.parametrize(("fault", "changes", "says"), FAULTS)
def test_an_unusable_message_is_counted_by_name_and_the_next_one_arrives(
    node: Node, fault: str, changes: dict[str, Any], says: str
) -> None:
    with listening(node) as source:
        joined(node, source)
        node.say(frame(time.monotonic(), 1, **changes))
        wait_for(lambda: bool(source.faults()))
        assert source.faults() == {fault: 1}
        assert re.search(says, source.last_fault)
        assert source.receive(0.0) is None
        assert until_heard(node, source, lambda: frame(time.monotonic(), 2)).qpos[0] == 2


@pytest.mark.parametrize(
    "payload", [b"", b"\x85\xa1t", b"\xc1", msgpack_arrays.pack([1, 2]), b"\x80", b"GET / HTTP/1.1\r\n\r\n"]
)
def test_garbage_is_counted_as_malformed(node: Node, payload: bytes) -> None:
    with listening(node) as source:
        joined(node, source)
        node.say(payload)
        wait_for(lambda: source.faults() == {"malformed": 1})
        assert until_heard(node, source, lambda: frame(time.monotonic(), 2)).qpos[0] == 2


def test_a_foreign_array_dialect_is_named(node: Node) -> None:
    foreign = {b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [7], b"data": b"\0" * 28}
    with listening(node) as source:
        joined(node, source)
        node.say(frame(time.monotonic(), state={"left_arm": foreign, "right_arm": foreign}))
        wait_for(lambda: source.faults() == {"malformed": 1})
        assert "MNP" in source.last_fault


def test_a_partial_message_right_after_a_complete_one_does_not_displace_it(node: Node) -> None:
    with listening(node) as source:
        joined(node, source)
        node.say(frame(time.monotonic(), 5))
        node.say(frame(time.monotonic(), 6, images={"cam_high": np.zeros((6, 8, 3), np.uint8)}))
        observation = source.receive(PATIENCE_S)
        assert observation is not None
        assert observation.qpos[0] == 5


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        (
            {"eef": {"left_arm": np.zeros(8, np.float32), "right_arm": np.zeros(8, np.float32)}},
            "eef_unusable",
        ),
        ({"eef": {"left_arm": np.ones(8, np.float32)}}, "eef_unusable"),
        ({"eef": [1]}, "eef_unusable"),
        ({"action": np.zeros(3, np.float32)}, "action_unusable"),
        ({"action_eef": np.zeros(16, np.float32)}, "action_eef_unusable"),
    ],
)
def test_an_unusable_optional_part_is_left_out_and_counted(
    node: Node, changes: dict[str, Any], fault: str
) -> None:
    with listening(node) as source:
        joined(node, source)
        node.say(frame(time.monotonic(), 3, **changes))
        observation = source.receive(PATIENCE_S)
        assert observation is not None
        assert observation.qpos[0] == 3
        assert observation.eef is None
        assert observation.reported_action is None
        assert observation.reported_action_eef is None
        assert "eef" not in observation.captured
        assert source.faults() == {fault: 1}


def test_gaps_in_the_nodes_own_numbers_are_counted_as_lost(node: Node) -> None:
    with listening(node) as source:
        joined(node, source)
        for number in (10, 11, 15):
            node.say(frame(time.monotonic(), number, seq=number))
            wait_for(lambda: source.receive(0.05) is not None)
        assert source.faults() == {"frames_lost": 3}
        node.say(frame(time.monotonic(), 0, seq=0))
        wait_for(lambda: source.receive(0.05) is not None)
        assert source.faults() == {"frames_lost": 3}


def test_what_the_node_says_of_itself_is_passed_on(node: Node) -> None:
    said: dict[str, Any] = {
        "holding": True,
        "refused": {"limits": 4},
        "master": "abc",
        "ack": 17,
        "hil_error": "no leader",
    }
    with listening(node) as source:
        until_heard(node, source, lambda: frame(time.monotonic(), **said))
        assert source.status.holding is True
        assert (source.status.master, source.status.ack) == ("abc", 17)
        assert source.status.hil_error == "no leader"
        assert source.faults() == {"node_refused.limits": 4}
        assert source.describe_fault("node_refused.limits") == "commands were beyond the node's own limits"
        assert source.describe_fault("node_refused.of_its_own") == ""


def test_two_readers_do_not_steal_each_others_frames(node: Node) -> None:
    with listening(node) as one, listening(node) as two:
        joined(node, one)
        joined(node, two)
        one.receive(0.2)
        node.say(frame(time.monotonic(), 42))
        seen = [source.receive(PATIENCE_S) for source in (one, two)]
    assert [None if each is None else each.qpos[0] for each in seen] == [42, 42]


def test_it_can_be_closed_twice_and_connected_again(node: Node) -> None:
    source = link.source(Config(sub_endpoint=node.obs), ROBOT, MonotonicClock())
    source.close()
    source.connect()
    source.close()
    source.close()
    source.connect()
    assert until_heard(node, source, lambda: frame(time.monotonic(), 4)).qpos[0] == 4
    source.close()


def test_an_address_that_libzmq_refuses_is_a_transport_error() -> None:
    config = Config(sub_endpoint="ipc://" + "x" * 500, pub_endpoint="ipc://" + "x" * 500)
    with pytest.raises(TransportError, match="cannot listen to the node at ipc"):
        link.source(config, ROBOT, MonotonicClock()).connect()
    with pytest.raises(TransportError, match="cannot reach the node at ipc"):
        link.sink(config, ROBOT, MonotonicClock()).connect()


def test_an_error_in_the_reader_is_counted_and_the_next_frame_comes(
    node: Node, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with listening(node) as source:
        joined(node, source)
        read, broken = source._messages.read, ["no room", "no room"]

        def breaking(payload: bytes) -> Any:
            if broken:
                raise MemoryError(broken.pop())
            return read(payload)

        monkeypatch.setattr(source._messages, "read", breaking)
        for _ in range(2):
            counted = source.faults().get("reader_failed", 0)
            node.say(frame(time.monotonic()))
            wait_for(lambda counted=counted: source.faults().get("reader_failed", 0) > counted)  # type: ignore[misc]
        node.say(frame(time.monotonic(), 7))
        observation = source.receive(PATIENCE_S)
        assert observation is not None
        assert observation.qpos[0] == 7
        assert source.faults()["reader_failed"] == 2
        assert source.last_fault.endswith("reading failed: MemoryError: no room")
    assert len([row for row in caplog.records if "no room" in row.message]) == 1  # said once, counted twice


def test_a_socket_that_fails_is_opened_anew(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_source, "_REOPEN_S", 0.05)
    with listening(node) as source:
        joined(node, source)
        drain, failing = node_source._drain, [True]

        def failed(socket: zmq.Socket[bytes]) -> list[bytes]:
            if failing:
                raise zmq.ZMQError(failing.pop() and zmq.ENOTSOCK)
            return drain(socket)

        monkeypatch.setattr(node_source, "_drain", failed)
        node.say(frame(time.monotonic(), 1))
        wait_for(lambda: source.faults().get("socket_failed") == 1)
        assert until_heard(node, source, lambda: frame(time.monotonic(), 9)).qpos[0] == 9


# Frozen cameras


def pictures(**values: int) -> dict[str, Any]:
    return {key: np.full((6, 8, 3), values.get(key, 0), np.uint8) for key in CAMERAS}


def received(node: Node, source: NodeSource, **values: int) -> Observation:
    node.say(frame(time.monotonic(), images=pictures(**values)))
    observation = source.receive(PATIENCE_S)
    assert observation is not None
    return observation


def test_a_picture_that_does_not_change_keeps_its_time_while_all_else_goes_on(node: Node) -> None:
    with listening(node) as source:
        joined(node, source)
        first = received(node, source, cam_high=1, cam_left_wrist=1, cam_right_wrist=1)
        second = received(node, source, cam_high=1, cam_left_wrist=2, cam_right_wrist=2)
        third = received(node, source, cam_high=2, cam_left_wrist=3, cam_right_wrist=3)
    assert second.captured["cam_high"] == first.captured["cam_high"] < second.captured["joints"]
    assert second.captured["cam_left_wrist"] == second.captured["joints"] > first.captured["joints"]
    assert third.captured["cam_high"] == third.captured["joints"]


def test_a_frozen_camera_is_a_fault_with_its_name(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.transports.frozen_cameras.FROZEN_S", 0.05)
    with listening(node) as source:
        joined(node, source)
        mark = 0
        while "frozen_cam_high" not in source.faults():
            mark = mark % 200 + 1
            received(node, source, cam_high=250, cam_left_wrist=mark, cam_right_wrist=mark)
        faults = source.faults()
    assert faults["frozen_cam_high"] == 1
    assert "frozen_cam_left_wrist" not in faults


def test_where_cameras_may_stand_still_every_picture_is_new(node: Node) -> None:
    with listening(node, detect_frozen=False) as source:
        joined(node, source)
        received(node, source, cam_high=1)
        second = received(node, source, cam_high=1)
    assert set(second.captured.values()) == {second.captured["joints"]}


def test_the_cameras_of_a_deployment_are_those_that_are_not_disabled() -> None:
    assert link.cameras(Config(), ROBOT) == CAMERAS
    assert link.cameras(Config(disabled_cameras=["cam_high"]), ROBOT) == CAMERAS[1:]


# Commands


def send_until_heard(node: Node, sink: NodeSink, command: RobotCommand) -> dict[str, Any]:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        sink.send(command)
        heard = node.hear(0.05)
        if heard is not None:
            return heard
    raise AssertionError("no command came through")


def test_a_command_has_the_fields_of_the_protocol(node: Node) -> None:
    action = np.linspace(0, 0.1, 14).astype(np.float32)
    with commanding(node) as sink:
        heard = send_until_heard(node, sink, RobotCommand(action, 3, 12.5))
    assert list(heard) == ["t", "action", "target", "master", "seq"]
    assert heard["t"] == 12.5
    assert heard["target"] == "real"
    assert heard["action"].dtype == np.float32
    np.testing.assert_array_equal(heard["action"], action)
    assert heard["master"] == sink.master
    assert heard["seq"] >= 1


def test_a_simulated_node_is_told_whose_row_a_command_is(node: Node) -> None:
    """A bench with a program of its own advances by the rows of a policy alone."""
    sink = link.sink(Config(pub_endpoint=node.act, simulated=True), ROBOT, MonotonicClock())
    with contextlib.closing(sink):
        sink.connect()
        row = RobotCommand(np.zeros(14, np.float32), 3, 12.5, source="policy")
        assert send_until_heard(node, sink, row)["source"] == "policy"


@pytest.mark.parametrize("word", ["collect_start", "collect_stop", "hil_start", "hil_stop"])
def test_words_of_the_protocol_have_the_form_of_a_command_that_moves_nothing(node: Node, word: str) -> None:
    """Older nodes read a vector in every message, and some take any for a target."""
    stands = np.linspace(0, 0.1, 14).astype(np.float32)
    with commanding(node) as sink:
        send_until_heard(node, sink, RobotCommand(stands, 1, 1.0))
        sink.send_control_word(word, {"mode": "relative"})
        heard = node.hear()
        while heard is not None and heard["target"] == "real":
            heard = node.hear()
    assert heard is not None
    assert list(heard) == ["t", "action", "target", "mode", "master", "seq"]
    assert heard["target"] == word
    np.testing.assert_array_equal(heard["action"], stands)


def test_a_link_that_is_cut_without_a_word_is_noticed(node: Node) -> None:
    with contextlib.closing(node_link.open_socket(zmq.SUB, node.obs, {})) as socket:
        assert socket.getsockopt(zmq.TCP_KEEPALIVE) == 1
        options = (zmq.TCP_KEEPALIVE_IDLE, zmq.TCP_KEEPALIVE_INTVL, zmq.TCP_KEEPALIVE_CNT)
        first, each, count = (int(socket.getsockopt(option)) for option in options)
    assert first + each * count <= 5


def test_every_sink_has_a_name_of_its_own() -> None:
    names = {link.sink(Config(), ROBOT, VirtualClock()).master for _ in range(5)}
    assert len(names) == 5


def test_sending_never_waits_for_a_node_that_is_not_there() -> None:
    with socket_address() as endpoint:
        sink = link.sink(Config(pub_endpoint=endpoint), ROBOT, MonotonicClock())
    sink.connect()
    with contextlib.closing(sink):
        for step in range(5000):
            sink.send(RobotCommand(np.zeros(14, np.float32), step, 0.0))
    assert sink._sequence == 5000


@contextlib.contextmanager
def socket_address() -> Iterator[str]:
    with contextlib.closing(Node()) as gone:
        yield gone.act


def test_a_node_that_comes_back_is_not_given_the_commands_of_the_moment_it_went_away() -> None:
    first = Node()
    with commanding(first) as sink:
        send_until_heard(first, sink, RobotCommand(np.zeros(14, np.float32), 0, 0.0))
        endpoints = first.obs, first.act
        first.close()
        for step in range(100):
            sink.send(RobotCommand(np.full(14, 0.5, np.float32), step, 1.0))
            time.sleep(0.002)
        with contextlib.closing(Node(*endpoints)) as second:
            heard = second.hear(1.0)
            assert heard is None
            fresh = send_until_heard(second, sink, RobotCommand(np.zeros(14, np.float32), 0, 2.0))
            assert fresh["t"] == 2.0


@pytest.mark.parametrize(
    "action", [np.zeros(13), np.zeros((1, 14)), np.full(14, np.nan), np.full(14, np.inf)]
)
def test_a_vector_that_no_node_may_be_given_is_refused(node: Node, action: Any) -> None:
    with commanding(node) as sink, pytest.raises(TransportError, match="allowed: 14 finite numbers"):
        sink.send(RobotCommand(action, 0, 0.0))


def test_sending_needs_a_connection() -> None:
    sink = link.sink(Config(), ROBOT, MonotonicClock())
    sink.close()
    with pytest.raises(TransportError, match="not connected"):
        sink.send(RobotCommand(np.zeros(14, np.float32), 0, 0.0))


# --- a simulated bench -------------------------------------------------------------------------------------

TRUTH = {
    "reset": "r-1",
    "seed": 3,
    "blocks": [[0.1, 0.3, 0.02, 0.5]],
    "plate": [0.0, 0.3],
    "held": [""],
    "milestones": {"grasped": True, "placed": False},
    "success": False,
}


def test_the_truth_of_a_node_that_is_declared_simulated_is_passed_on(node: Node) -> None:
    with listening(node, simulated=True) as source:
        seen = until_heard(node, source, lambda: frame(time.monotonic(), truth=TRUTH))
        assert seen.truth == TRUTH
        assert source.faults() == {}
        assert until_heard(node, source, lambda: frame(time.monotonic())).truth is None


def test_the_truth_of_any_other_node_is_ignored_and_that_is_said_once(node: Node) -> None:
    with listening(node) as source:
        for _ in range(3):
            assert until_heard(node, source, lambda: frame(time.monotonic(), truth=TRUTH)).truth is None
        assert source.faults() == {"truth_ignored": 1}
        assert "transport.simulated is false" in source.last_fault


@pytest.mark.parametrize(
    ("truth", "says"),
    [
        (7, "truth: Input should be a valid dictionary"),
        (TRUTH | {"blocks": np.zeros((1, 4))}, "truth.blocks: input was not a valid JSON value"),
        (TRUTH | {"plate": [float("nan"), 0.0]}, "truth.plate: Input should be a finite number"),
        (TRUTH | {"reset": None}, "truth.reset is None; expected the id of a reset or ''"),
        (TRUTH | {"success": 1}, "truth.success is 1; expected true or false"),
        (TRUTH | {"milestones": {"placed": 1}}, "truth.milestones is {'placed': 1}; expected a map of bools"),
        (TRUTH | {"blocks": "x" * 20_000}, "bytes; expected at most 16384"),
    ],
)
def test_a_truth_that_cannot_be_used_is_left_out_and_named(node: Node, truth: object, says: str) -> None:
    with listening(node, simulated=True) as source:
        seen = until_heard(node, source, lambda: frame(time.monotonic(), truth=truth))
        assert seen.truth is None
        assert set(source.faults()) == {"truth_unusable"}
        assert says in source.last_fault


@pytest.mark.parametrize(
    ("drives", "seen"),
    [
        ({"enabled": True, "faults": []}, {"enabled": True, "faults": []}),
        ({"enabled": False, "faults": ["hot"], "more": 1}, {"enabled": False, "faults": ["hot"]}),
        ({"enabled": False}, {"enabled": False, "faults": []}),
        (..., None),
    ],
)
def test_the_drive_state_of_any_node_is_passed_on(node: Node, drives: Any, seen: Any) -> None:
    with listening(node) as source:
        assert until_heard(node, source, lambda: frame(time.monotonic(), drives=drives)).drives == seen
        assert source.faults() == {}


@pytest.mark.parametrize(
    ("drives", "says"),
    [
        (True, "drives is a bool; expected a map"),
        ({"enabled": 1, "faults": []}, "drives.enabled is 1; expected true or false"),
        ({"faults": []}, "drives.enabled is None; expected true or false"),
        ({"enabled": True, "faults": "hot"}, "drives.faults is 'hot'; expected a list of sentences"),
        ({"enabled": True, "faults": [7]}, "drives.faults is [7]; expected a list of sentences"),
        ({"enabled": True, "faults": ["x"] * 65}, "drives.faults are 65 of at most 1 characters"),
        ({"enabled": True, "faults": ["x" * 201]}, "expected at most 64 of 200"),
    ],
)
def test_a_drive_state_that_cannot_be_used_is_left_out_and_named(node: Node, drives: Any, says: str) -> None:
    with listening(node) as source:
        seen = until_heard(node, source, lambda: frame(time.monotonic(), 1, drives=drives))
        assert seen.drives is None
        assert seen.qpos[0] == 1
        assert set(source.faults()) == {"drives_unusable"}
        assert says in source.last_fault


@pytest.mark.parametrize("simulated", [True, False])
def test_only_a_node_that_is_declared_simulated_is_told_to_reset_its_bench(simulated: bool) -> None:
    assert link.capabilities(Config(simulated=simulated)).bench == ("tabletop" if simulated else "")


def test_a_control_word_says_who_sends_it_and_stands_where_a_command_says_its_target(node: Node) -> None:
    with commanding(node) as sink:
        data = {"id": "r-1", "seed": 3, "positions": {"block": [0.1, 0.3, 45.0]}}
        heard = None
        while heard is None:  # until the link is up
            sink.send_control_word("scene_reset", data)
            heard = node.hear(0.1)
        assert {key: heard[key] for key in data} == data
        assert (heard["target"], heard["master"]) == ("scene_reset", sink.master)
        assert isinstance(heard["t"], float)
        before = heard["seq"]
        sink.send(RobotCommand(np.zeros(ROBOT.dim, np.float32), 1, 2.0))
        command = node.hear()
        while command is not None and command["target"] != "real":
            command = node.hear()
        assert command is not None
        assert (command["master"], command["seq"] > before) == (sink.master, True)


@pytest.mark.parametrize(
    ("word", "data"),
    [("real", {}), ("sim", {}), ("scene_reset", {"action": [0.0]}), ("scene_reset", {"master": "x"})],
)
def test_a_control_word_cannot_be_taken_for_a_command(node: Node, word: str, data: dict[str, Any]) -> None:
    with commanding(node) as sink, pytest.raises(TransportError, match="would be taken for a command"):
        sink.send_control_word(word, data)


def test_a_control_word_over_no_link_is_a_fault() -> None:
    sink = link.sink(Config(), ROBOT, VirtualClock())
    with pytest.raises(TransportError, match="is not connected"):
        sink.send_control_word("scene_reset", {"id": "r"})
