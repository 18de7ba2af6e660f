"""What a host does with its device: an execution node, a leader, or a publisher of pictures.

LeRobot's environment runs this module.
"""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import zmq

from runtime.core import msgpack_arrays
from runtime.core.command_filter import CommandFilter
from runtime.core.node_sockets import Sockets, bound
from runtime.lerobot.devices import DeviceRefused, require_action, require_features
from runtime.lerobot.features import JointMap, read_image

_WAKE_MS = 50  # time until the receiver thread notices that it must end [ms]
_FRAME_MS = 200.0  # wait for a camera's next picture [ms]


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
        """Return the settings of a file or line. Raises DeviceRefused for a missing or unknown key."""
        try:
            settings = cls(**table)
        except TypeError as error:
            raise DeviceRefused(f"{error}; allowed: {', '.join(cls.__dataclass_fields__)}") from None
        if settings.role not in ROLES:
            raise DeviceRefused(f"role = {settings.role!r}; allowed: {', '.join(ROLES)}")
        if settings.role == "robot" and not settings.commands:
            raise DeviceRefused("commands is missing; expected: the endpoint of a robot's commands")
        return settings


class Commands:
    """Newest accepted command; a thread receives, so that each command has its true time of arrival.

    A device that does not return from a call leaves commands waiting; they are too old when it does.
    """

    def __init__(self, sockets: Sockets, dim: int, deadline: float, same_clock: bool) -> None:
        self._sockets, self._deadline = sockets, deadline
        self._filter = CommandFilter(dim, deadline, same_clock=same_clock)
        self._lock = threading.Lock()
        self._newest: tuple[np.ndarray[Any, Any], float] | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="commands", daemon=True)
        self._thread.start()

    def pop_newest(self) -> np.ndarray[Any, Any] | None:
        """Return the newest target [D] that was not returned yet; None without one, or if it is beyond the deadline."""
        with self._lock:
            newest, self._newest = self._newest, None
        if newest is None or time.monotonic() - newest[1] > self._deadline:
            return None
        return newest[0]

    def status(self) -> dict[str, Any]:
        """Return the fields of an observation that say which commands the node accepts."""
        with self._lock:
            commands = self._filter
            status = {
                "holding": commands.is_silent(time.monotonic()),
                "refused": dict(commands.refused),
                "master": commands.master or "",
            }
            return status if commands.ack is None else status | {"ack": commands.ack}

    def close(self) -> None:
        """End the thread."""
        self._ending.set()
        self._thread.join()

    def _receive(self) -> None:
        while not self._ending.is_set():
            for payload in self._sockets.received(_WAKE_MS):
                now = time.monotonic()
                with self._lock:
                    target = self._filter.accept_target(payload, now)
                    if target is not None:
                        self._newest = target, now


class Role(ABC):
    """What a host does with its device."""

    @abstractmethod
    def require(self, device: Any) -> None:
        """Raise DeviceRefused unless the device has the features that the settings name."""

    @abstractmethod
    def step(self, device: Any) -> None:
        """Read the device once and publish it. Raises UnusableValue, or any error of the device."""

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
        self._sockets = Sockets(settings.observations, settings.commands, settings.insecure_link)
        dim = len(self._joints.features)
        self._commands = Commands(self._sockets, dim, settings.deadline_s, settings.same_clock)

    def require(self, device: Any) -> None:
        require_features(device, self._joints.features, list(self._cameras.values()))
        self._shapes = {name: device.observation_features[name] for name in self._cameras.values()}

    def step(self, device: Any) -> None:
        """Publish an observation, then execute the newest command; both in one thread, because they share a bus."""
        stamp = time.monotonic()  # LeRobot gives no capture times: no value can be older than this
        values = device.get_observation()
        images = {key: read_image(name, values, self._shapes[name]) for key, name in self._cameras.items()}
        observation = {"t": stamp, "state": self._joints.read_state(values), "images": images}
        self._sequence += 1
        status = {"encoding": "rgb", "seq": self._sequence, **self._commands.status()}
        self._sockets.publish(msgpack_arrays.pack(observation | status))
        target = self._commands.pop_newest()
        if target is not None:
            device.send_action(self._joints.write_action(target))

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

    def step(self, device: Any) -> None:
        stamp = time.monotonic()
        state = self._joints.read_state(device.get_action())
        _publish(self._socket, {"t": stamp, "state": state})

    def close(self) -> None:
        self._socket.close(linger=0)


class CameraRole(Role):
    """Publisher of a camera's pictures; each is published once."""

    def __init__(self, settings: HostSettings) -> None:
        self._socket = bound(zmq.PUB, settings.observations, settings.insecure_link)
        self._before: float | None = None

    def require(self, device: Any) -> None:
        """Begin anew: a picture from before this connection has an unknown age."""
        self._before = None

    def step(self, device: Any) -> None:
        """Publish the next picture. Its time is the end of the previous read: it was captured after that."""
        try:
            image = device.async_read(timeout_ms=_FRAME_MS)
        except TimeoutError:
            return
        before, self._before = self._before, time.monotonic()
        if before is not None:
            _publish(self._socket, {"t": before, "image": read_image("frame", {"frame": image}, None)})

    def close(self) -> None:
        self._socket.close(linger=0)


ROLES: Mapping[str, Callable[[HostSettings], Role]] = MappingProxyType(
    {"robot": RobotRole, "teleoperator": TeleoperatorRole, "camera": CameraRole}
)


def _publish(socket: zmq.Socket[bytes], message: Mapping[str, Any]) -> None:
    with contextlib.suppress(zmq.Again):  # nobody reads; the next one is newer
        socket.send(msgpack_arrays.pack(message), zmq.NOBLOCK)
