"""What a host does with its device: an execution node, a leader, or a publisher of pictures.

LeRobot's environment runs this module.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import zmq

from runtime.core import msgpack_arrays
from runtime.core.command_filter import CommandFilter
from runtime.core.node_sockets import Sockets, bound
from runtime.lerobot.devices import DeviceRefused, require_action, require_degrees, require_features
from runtime.lerobot.features import JointMap, read_image

_WAKE_MS = 50  # time until the receiver thread notices that it must end [ms]
_FRAME_MS = 200.0  # wait for a camera's next picture [ms]
_NEWS_S = 1.0  # age of a command beyond which it says nothing of the e-stop [s]
_NEAR_COMMANDS = 5  # in turn, so that those of a hold that moves to the joints are past
_QUEUED_PICTURES = 5  # more than a driver's queue has
_GAP_S, _LEAST_GAP_S = 1.0, 0.25  # between pictures of a camera without and with a known rate [s]


@dataclass(frozen=True)
class HostSettings:
    """Settings of a host; tables as in a deployment."""

    role: str
    device: Mapping[str, Any]
    observations: str  # endpoint at which observations, leader poses or pictures are published
    commands: str = ""  # endpoint of a robot's commands
    joints: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)
    cameras: Mapping[str, str] = field(default_factory=dict)  # observation key = picture of the device
    rate: float = 30.0  # [Hz]
    deadline_s: float = 0.3
    insecure_link: bool = False
    same_clock: bool = False  # the sender of commands is on this machine

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> HostSettings:
        """Return the settings of a file or line. Raises DeviceRefused, with the key and what is allowed."""
        try:
            settings = cls(**table)
        except TypeError as error:
            raise DeviceRefused(f"{error}; allowed: {', '.join(cls.__dataclass_fields__)}") from None
        for key, allowed, is_valid in _ALLOWED:
            value = getattr(settings, key)
            if not is_valid(value):
                raise DeviceRefused(f"{key} = {value!r:.200}; allowed: {allowed}")
        if settings.role == "robot" and not settings.commands:
            raise DeviceRefused("commands is missing; expected: the endpoint of a robot's commands")
        return settings


def _is_number(value: object, largest: float) -> bool:
    return type(value) in (int, float) and 0 < value <= largest  # type: ignore[operator]


def _is_of_texts(value: object) -> bool:
    return isinstance(value, Mapping) and all(isinstance(text, str) for text in value.values())


# Key, what is allowed, and whether a value is.
_ALLOWED: tuple[tuple[str, str, Callable[[Any], bool]], ...] = (
    ("role", "robot, teleoperator, camera", lambda value: isinstance(value, str) and value in ROLES),
    (
        "device",
        "a table with its `type`",
        lambda value: isinstance(value, Mapping) and isinstance(value.get("type"), str),
    ),
    (
        "observations",
        "an endpoint such as tcp://127.0.0.1:5555",
        lambda value: isinstance(value, str) and "://" in value,
    ),
    (
        "commands",
        "an endpoint such as tcp://127.0.0.1:5556",
        lambda value: value == "" or (isinstance(value, str) and "://" in value),
    ),
    ("cameras", "observation key = picture of the device", _is_of_texts),
    ("rate", "above 0, up to 1000 Hz", lambda value: _is_number(value, 1000.0)),
    ("deadline_s", "above 0, up to 5 s", lambda value: _is_number(value, 5.0)),
    ("insecure_link", "true, false", lambda value: isinstance(value, bool)),
    ("same_clock", "true, false", lambda value: isinstance(value, bool)),
)


@dataclass(frozen=True)
class Command:
    """Accepted command: target [D], time of sending [s], its sender and number there."""

    target: np.ndarray[Any, Any]
    sent: float
    master: str
    number: int | None


class Commands:
    """Newest accepted command; a thread receives, so that each command has its true time of arrival.

    A device that does not return from a call leaves commands waiting; they are too old when it does. After each
    connection none is executed before a few in turn were near to the measured joints: until then the station holds the
    robot where it was, and a robot that has sagged meanwhile would jump there.
    """

    def __init__(
        self, sockets: Sockets, tolerance: np.ndarray[Any, Any], deadline: float, same_clock: bool
    ) -> None:
        self._sockets, self._deadline, self._tolerance = sockets, deadline, tolerance
        self._filter = CommandFilter(len(tolerance), deadline, same_clock=same_clock)
        self._lock = threading.Lock()
        self._newest: Command | None = None
        self._since = math.inf  # commands that were sent before are not executed [s]
        self._near = 0  # successive commands that were near to the joints, up to _NEAR_COMMANDS
        self._executed = -math.inf  # when the device has returned from the last command [s]
        self._acknowledged: Command | None = None
        self._refused: Counter[str] = Counter()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="commands", daemon=True)
        self._thread.start()

    @property
    def are_stopped(self) -> bool:
        """Whether the station holds its robot because of the e-stop, according to its newest commands."""
        with self._lock:
            commands = self._filter
            return commands.source == "estop" and time.monotonic() - commands.sent < _NEWS_S

    def begin(self) -> None:
        """Execute commands that are sent from now on: the first observation of a connection is published."""
        with self._lock:
            self._since = time.monotonic()

    def pop_newest(self, measured: np.ndarray[Any, Any]) -> Command | None:
        """Return the newest command that was not returned yet; None without one, or if it may not be executed now.

        `measured` [D] are the joints that were just read.
        """
        with self._lock:
            newest, self._newest = self._newest, None
            if newest is None or newest.sent < self._since or time.monotonic() - newest.sent > self._deadline:
                return None
            if self._near < _NEAR_COMMANDS:
                is_near = bool((np.abs(newest.target - measured) <= self._tolerance).all())
                self._near = self._near + 1 if is_near else 0
                if self._near < _NEAR_COMMANDS:
                    self._refused["displaced"] += 1
                    return None
            return newest

    def confirm(self, command: Command) -> None:
        """Note that the device has executed a command."""
        with self._lock:
            self._executed, self._acknowledged = time.monotonic(), command

    def refuse(self) -> None:
        """Note that the device has refused a command."""
        with self._lock:
            self._refused["device"] += 1

    def status(self) -> dict[str, Any]:
        """Return the fields of an observation that say which commands the node accepts."""
        with self._lock:
            master, done = self._filter.master or "", self._acknowledged
            status: dict[str, Any] = {
                "holding": time.monotonic() - self._executed > self._deadline,
                "refused": dict(self._filter.refused + self._refused),
                "master": master,
            }
            if done is not None and done.master == master and done.number is not None:
                status["ack"] = done.number
            return status

    def close(self) -> None:
        """End the thread."""
        self._ending.set()
        self._thread.join()

    def _receive(self) -> None:
        while not self._ending.is_set():
            for payload in self._sockets.received(_WAKE_MS):
                with self._lock:
                    commands = self._filter
                    target = commands.accept_target(payload, time.monotonic())
                    if target is not None:
                        self._newest = Command(target, commands.sent, commands.master or "", commands.ack)


class Role(ABC):
    """What a host does with its device."""

    @property
    def are_stopped(self) -> bool:
        """Whether the e-stop forbids to connect the device: most switch their motors on."""
        return False

    @abstractmethod
    def require(self, device: Any) -> None:
        """Raise DeviceRefused unless the device has the features that the settings name."""

    @abstractmethod
    def step(self, device: Any) -> bool:
        """Read the device once, publish what it gives, and return False if it gave nothing.

        Raises UnusableValue, or any error of the device.
        """

    def command(self, device: Any) -> None:  # noqa: B027 - leaders and cameras execute none
        """Execute the newest command, if there is one. Raises any error of the device."""

    @abstractmethod
    def close(self) -> None:
        """Release the sockets."""


class RobotRole(Role):
    """Execution node of one robot."""

    def __init__(self, settings: HostSettings) -> None:
        self._joints = JointMap.from_tables(settings.joints)
        self._cameras = settings.cameras
        self._shapes: dict[str, Any] = {}
        self._sequence = 0
        self._measured: np.ndarray[Any, Any] | None = None  # joints of the last step, if it was published
        self._sockets = Sockets(settings.observations, settings.commands, settings.insecure_link)
        self._commands = Commands(
            self._sockets, self._joints.tolerance, settings.deadline_s, settings.same_clock
        )

    @property
    def are_stopped(self) -> bool:
        return self._commands.are_stopped

    def require(self, device: Any) -> None:
        require_features(device, self._joints.features, list(self._cameras.values()))
        require_degrees(device, self._joints.in_degrees)
        self._shapes = {name: device.observation_features[name] for name in self._cameras.values()}

    def step(self, device: Any) -> bool:
        """Publish an observation; commands follow in the same thread, because they share a bus."""
        self._measured = None
        stamp = (
            time.monotonic()
        )  # LeRobot gives no capture times: nothing that is read now is older than this
        values = device.get_observation()
        images = {key: read_image(name, values, self._shapes[name]) for key, name in self._cameras.items()}
        state = self._joints.read_state(values)
        self._sequence += 1
        status = {"encoding": "rgb", "seq": self._sequence, **self._commands.status()}
        self._sockets.publish(msgpack_arrays.pack({"t": stamp, "state": state, "images": images, **status}))
        if self._sequence == 1:
            self._commands.begin()
        self._measured = np.concatenate(list(state.values()))
        return True

    def command(self, device: Any) -> None:
        """Execute the newest command, unless the joints of this turn are unknown."""
        command = None if self._measured is None else self._commands.pop_newest(self._measured)
        if command is None:
            return
        try:
            device.send_action(self._joints.write_action(command.target))
        except Exception:  # of the device's own code
            self._commands.refuse()
            raise
        self._commands.confirm(command)

    def close(self) -> None:
        self._commands.close()
        self._sockets.close()


class TeleoperatorRole(Role):
    """Leader that publishes its joints."""

    def __init__(self, settings: HostSettings) -> None:
        self._joints = JointMap.from_tables(settings.joints)
        self._socket = bound(zmq.PUB, settings.observations, settings.insecure_link)

    def require(self, device: Any) -> None:
        require_action(device, self._joints.features)
        require_degrees(device, self._joints.in_degrees)

    def step(self, device: Any) -> bool:
        stamp = time.monotonic()
        state = self._joints.read_state(device.get_action())
        _publish(self._socket, {"t": stamp, "state": state})
        return True

    def close(self) -> None:
        self._socket.close(linger=0)


class CameraRole(Role):
    """Publisher of a camera's pictures; each is published once.

    The time of a picture is the end of the read before it. That is not before its capture while pictures are read as
    they come; after a gap the camera's own queue may have older ones, which are left out.
    """

    def __init__(self, settings: HostSettings) -> None:
        self._socket = bound(zmq.PUB, settings.observations, settings.insecure_link)
        self._gap_s = _GAP_S
        self._before = -math.inf  # end of the last read with a picture [s]
        self._unknown = _QUEUED_PICTURES  # pictures that are left out

    def require(self, device: Any) -> None:
        """Begin anew: pictures from before this connection have an unknown age."""
        fps = getattr(device, "fps", None)
        if isinstance(fps, int | float) and fps > 0:
            self._gap_s = max(_LEAST_GAP_S, 3.0 / fps)

    def step(self, device: Any) -> bool:
        try:
            image = device.async_read(timeout_ms=_FRAME_MS)
        except TimeoutError:
            return False
        before, self._before = self._before, time.monotonic()
        self._unknown = _QUEUED_PICTURES if self._before - before > self._gap_s else max(0, self._unknown - 1)
        if not self._unknown:
            _publish(self._socket, {"t": before, "image": read_image("frame", {"frame": image}, None)})
        return True

    def close(self) -> None:
        self._socket.close(linger=0)


ROLES: Mapping[str, Callable[[HostSettings], Role]] = MappingProxyType(
    {"robot": RobotRole, "teleoperator": TeleoperatorRole, "camera": CameraRole}
)


def _publish(socket: zmq.Socket[bytes], message: Mapping[str, Any]) -> None:
    with contextlib.suppress(zmq.Again):  # nobody reads; the next one is newer
        socket.send(msgpack_arrays.pack(message), zmq.NOBLOCK)
