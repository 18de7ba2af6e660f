"""Robots that a test plays over a real wire, rightly or wrongly, and the source of ours that hears them."""

from __future__ import annotations

import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
import zmq

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.types import Observation
from runtime.standins import arrays
from runtime.transports import ros1, ros2
from runtime.transports import zmq as node
from runtime.transports.base import Source
from runtime.transports.ros import cdr, ros1_serialization
from runtime.transports.ros.messages import Image, JointState, Message
from runtime.transports.ros.middleware import SENSOR_QUALITY, Middleware, Publish, Topic
from runtime.transports.ros.topics import GroupTopics, Topics
from tests.processes import PATIENCE_S
from tests.runtime.ros_master import PYTHON, absent

ROBOT = robots.load_robot("ur5e")
(ARM,) = ROBOT.groups
WRIST, HIGH = (camera.key for camera in ROBOT.cameras)
STALLED_S = 0.3
CLOCK = MonotonicClock()
NOISE = bytes(range(256)) * 3


class Told(NamedTuple):
    """What is said of a fault: the name under which it is counted, and words of the sentence."""

    name: str
    words: str


class Played(ABC):
    """A robot in the hands of a test, and `source`, which is connected to it.

    `faults` are the ways of this wire to be wrong; `none` has those that it cannot have, and why.
    """

    faults: ClassVar[Mapping[str, Told]]
    none: ClassVar[Mapping[str, str]]
    source: Source

    def __init__(self) -> None:
        self.offset = 0.0  # of the robot's clock
        self.size = (24, 32)  # of pictures
        self._pictures = 0

    @abstractmethod
    def play(self, mark: int, fault: str = "") -> None:
        """One frame whose first joint is `mark`/100, with pictures never shown before."""

    @abstractmethod
    def another(self) -> Source:
        """A second source of the same robot."""

    @abstractmethod
    def restart(self) -> None:
        """The robot's process dies and another one takes its place."""

    @abstractmethod
    def close(self) -> None:
        """End both sides."""

    def joints(self, mark: int) -> np.ndarray[Any, Any]:
        made = np.zeros(ROBOT.dim)
        made[0] = mark / 100
        return made

    def picture(self) -> np.ndarray[Any, Any]:
        self._pictures += 1
        made = np.zeros((*self.size, 3), np.uint8)
        made[..., 0], made[..., 1] = self._pictures % 256, self._pictures // 256 % 256
        return made


def mark_of(seen: Observation) -> int:
    return round(float(seen.qpos[0]) * 100)


# Execution nodes over ZMQ


class ZmqPlayed(Played):
    """PUB and SUB as existing nodes have them; arrays are written by a codec that is not the client's."""

    faults: ClassVar[Mapping[str, Told]] = {
        "camera_missing": Told("missing_camera", "images lack cam_high; they have cam_wrist"),
        "joints_missing": Told("missing_group", "state lacks arm; it has none"),
        "picture_dtype": Told("wrong_dtype", "images.cam_wrist is <f4; expected a uint8 array"),
        "picture_shape": Told("wrong_dimension", "images.cam_wrist has shape [3, 24, 32]"),
        "joint_dtype": Told("wrong_dtype", "state.arm is <i8; expected a float32 array"),
        "joint_dimension": Told("wrong_dimension", "state.arm has shape [6]; expected [7]"),
        "not_finite": Told("not_finite", "state.arm has [nan"),
        "no_stamp": Told("malformed", "t is None; expected seconds of the node's monotonic clock"),
        "truncated": Told("malformed", "bytes are not one msgpack message"),
        "noise": Told("malformed", "bytes are not one msgpack message"),
        "dialect_mnp": Told("malformed", "MNP"),
        "dialect_npy": Told("malformed", "NPY"),
        "object_array": Told("malformed", "refused (objects"),
        "no_map": Told("malformed", "a message is a list; expected a map"),
    }
    none: ClassVar[Mapping[str, str]] = {}

    def __init__(self) -> None:
        super().__init__()
        self._socket, self._endpoint = _published("tcp://127.0.0.1:0")
        self.source = self.another()

    def another(self) -> Source:
        config = node.Config(sub_endpoint=self._endpoint, stalled_after_s=STALLED_S)
        source = node.source(config, ROBOT, CLOCK)
        source.connect()
        return source

    def play(self, mark: int, fault: str = "") -> None:
        message: dict[str, Any] = {
            "t": time.monotonic() + self.offset,
            "images": {WRIST: self.picture(), HIGH: self.picture()},
            "state": {"arm": self.joints(mark).astype(np.float32)},
            "hil_supported": False,
            "hil_active": False,
        }
        self._socket.send(_SPOILT[fault](message) if fault else arrays.packed(message))

    def restart(self) -> None:
        self._socket.close(linger=0)
        self._socket, _ = _published(self._endpoint)

    def close(self) -> None:
        self.source.close()
        self._socket.close(linger=0)


def _published(endpoint: str) -> tuple[zmq.Socket[bytes], str]:
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PUB)
    socket.setsockopt(zmq.SNDHWM, 8)  # what it hoards itself is not what is looked for
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            socket.bind(endpoint)
        except zmq.ZMQError:  # the address of one that was closed a moment ago
            assert time.monotonic() < until, endpoint
            time.sleep(0.01)
        else:
            raw = socket.getsockopt(zmq.LAST_ENDPOINT)
            assert isinstance(raw, bytes)
            return socket, raw.rstrip(b"\0").decode()


def _with(part: str, key: str, change: Callable[[Any], Any]) -> Callable[[dict[str, Any]], bytes]:
    return lambda m: arrays.packed(m | {part: m[part] | {key: change(m[part][key])}})


def _mnp(value: Any) -> dict[bytes, Any]:
    fields = {b"nd": True, b"type": value.dtype.str, b"kind": b"", b"shape": list(value.shape)}
    return fields | {b"data": value.tobytes()}


_SPOILT: dict[str, Callable[[dict[str, Any]], bytes]] = {
    "camera_missing": lambda m: arrays.packed(m | {"images": {WRIST: m["images"][WRIST]}}),
    "joints_missing": lambda m: arrays.packed(m | {"state": {}}),
    "picture_dtype": _with("images", WRIST, lambda one: one.astype(np.float32)),
    "picture_shape": _with("images", WRIST, lambda one: one.transpose(2, 0, 1)),
    "joint_dtype": _with("state", "arm", lambda one: one.astype(np.int64)),
    "joint_dimension": _with("state", "arm", lambda one: one[:6]),
    "not_finite": _with("state", "arm", lambda one: one * np.nan),
    "no_stamp": lambda m: arrays.packed({key: value for key, value in m.items() if key != "t"}),
    "truncated": lambda m: arrays.packed(m)[:-7],
    "noise": lambda m: NOISE[:: 1 + len(m) % 2],
    "dialect_mnp": _with("state", "arm", _mnp),
    "dialect_npy": _with("state", "arm", lambda one: {"__ndarray_class__": True, "as_npy": b"\x93NUMPY"}),
    "object_array": _with(
        "state", "arm", lambda one: {b"__ndarray__": True, b"data": b"N.", b"dtype": "|O", b"shape": [1]}
    ),
    "no_map": lambda m: bytes(msgpack.packb([1, 2])),
}


# Topics of ROS

TOPICS = Topics(
    cameras={"wrist_image": "/wrist", "exterior_image": "/high"},
    groups={"arm": GroupTopics(state="/state", command="/command")},
)
_MESSAGES: dict[str, Any] = {"/state": "JointState", "/wrist": "Image", "/high": "Image"}


class RosWire(NamedTuple):
    """A generation of ROS: its transport, how messages are written, what of a Config it needs."""

    transport: ModuleType
    encode: Callable[[Message], bytes]
    settings: Mapping[str, Any]
    middleware: Callable[[Any], Middleware]


class RosPlayed(Played):
    """Publishers of three topics; the messages go through the middleware as bytes, so broken ones do too."""

    faults: ClassVar[Mapping[str, Told]] = {
        "camera_missing": Told("stalled_cam_high", "waiting for cam_high (/high): nothing for"),
        "joints_missing": Told("stalled_arm_joints", "waiting for arm joints (/state): nothing for"),
        "picture_dtype": Told("wrong_encoding", "a picture is '32FC1'; allowed: bgr8"),
        "picture_shape": Told("wrong_dimension", "a picture of 32 x 24 bgr8 has rows of 96 bytes and 2297"),
        "joint_dimension": Told("joint_names", f"lack {ARM.joints[6]}; expected {ARM.joints[0]}"),
        "joint_names": Told("joint_names", f"lack {ARM.joints[0]}; expected {ARM.joints[0]}"),
        "not_finite": Told("not_finite", "positions are [nan"),
        "no_stamp": Told("unstamped", "its header has no stamp"),
        "truncated": Told("malformed", "/state: "),
        "noise": Told("malformed", "/state: "),
    }
    none: ClassVar[Mapping[str, str]] = {
        "joint_dtype": "numbers of a JointState are always doubles",
        "dialect_mnp": "arrays are the middleware's own",
        "dialect_npy": "arrays are the middleware's own",
        "object_array": "arrays are the middleware's own",
        "no_map": "a topic has a type, which the middleware compares",
    }

    def __init__(self, wire: RosWire) -> None:
        super().__init__()
        self._wire = wire
        self._config = wire.transport.Config(topics=TOPICS, stalled_after_s=STALLED_S, **wire.settings)
        self._open()
        self.source = self.another()

    def another(self) -> Source:
        source: Source = self._wire.transport.source(self._config, ROBOT, CLOCK)
        source.connect()
        return source

    def play(self, mark: int, fault: str = "") -> None:
        stamp = time.time_ns() + round(self.offset * 1e9)
        arm = JointState(stamp, "", ARM.joints, self.joints(mark))
        missing = {"camera_missing": "/high", "joints_missing": "/state"}.get(fault)
        for topic, message in (
            ("/state", arm),
            ("/wrist", self._image(stamp)),
            ("/high", self._image(stamp)),
        ):
            if topic != missing:
                self._publish[topic](self._payload(topic, message, fault))

    def _payload(self, topic: str, message: Any, fault: str) -> bytes:
        if topic == "/wrist" and fault == "picture_dtype":
            message = replace(message, encoding="32FC1")
        if topic == "/wrist" and fault == "picture_shape":
            message = replace(message, data=message.data[:-7])
        if topic != "/state":
            return self._wire.encode(message)
        changes: dict[str, dict[str, Any]] = {
            "joint_dimension": {"names": ARM.joints[:6], "position": message.position[:6]},
            "joint_names": {"names": ("x", *ARM.joints[1:])},
            "not_finite": {"position": message.position * np.nan},
            "no_stamp": {"stamp": 0},
        }
        payload = self._wire.encode(replace(message, **changes.get(fault, {})))
        if fault == "truncated":
            return payload[:-7]
        return payload[:4] + NOISE if fault == "noise" else payload

    def _image(self, stamp: int) -> Image:
        pixels = self.picture()
        height, width, channels = pixels.shape
        return Image(stamp, "", height, width, "bgr8", channels * width, pixels.reshape(-1))

    def _open(self) -> None:
        self._robot = self._wire.middleware(self._config)
        self._publish: dict[str, Publish] = {
            name: self._robot.advertise(Topic(name, kind, SENSOR_QUALITY)) for name, kind in _MESSAGES.items()
        }

    def restart(self) -> None:
        self._robot.close()
        self._open()

    def close(self) -> None:
        self.source.close()
        self._robot.close()


class Ros2Played(RosPlayed):
    """Over DDS, which compares bytes with their type on both sides."""

    faults: ClassVar[Mapping[str, Told]] = {
        name: told for name, told in RosPlayed.faults.items() if told.name != "malformed"
    }
    none: ClassVar[Mapping[str, str]] = dict(RosPlayed.none) | dict.fromkeys(
        ("truncated", "noise"), "Cyclone DDS writes and delivers no such bytes"
    )


def _ros2(request: pytest.FixtureRequest) -> Played:
    pytest.importorskip("cyclonedds", reason="the package cyclonedds (extra ros2) is not installed")
    settings = {"domain": request.getfixturevalue("domain")}
    return Ros2Played(RosWire(ros2, cdr.encode, settings, lambda config: ros2.middleware(config, "robot")))


def _ros1(request: pytest.FixtureRequest) -> Played:
    if absent():
        pytest.skip(absent())
    settings = {"master": request.getfixturevalue("ros_master").uri, "python": PYTHON}
    return RosPlayed(
        RosWire(ros1, ros1_serialization.encode, settings, lambda config: ros1.middleware(config, "robot"))
    )


# A further transport joins by a line: what opens it, with the fixtures it needs.
TRANSPORTS: dict[str, tuple[type[Played], Callable[[pytest.FixtureRequest], Played]]] = {
    "zmq": (ZmqPlayed, lambda request: ZmqPlayed()),
    "ros2": (Ros2Played, _ros2),
    "ros1": (RosPlayed, _ros1),
}


@contextlib.contextmanager
def played(name: str, request: pytest.FixtureRequest) -> Iterator[Played]:
    with contextlib.closing(TRANSPORTS[name][1](request)) as made:
        yield made
