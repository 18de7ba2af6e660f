"""Sink of commands to a robot's topics: one message per group, all with the same stamp."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.clock import Clock
from runtime.core.errors import TransportError
from runtime.core.types import EEF_WIDTH, Float32, RobotCommand
from runtime.transports.base import Sink
from runtime.transports.ros.messages import JointState, Message, PoseStamped, Wire
from runtime.transports.ros.middleware import Middleware, Publish, Topic
from runtime.transports.ros.topics import CommandTopic

if TYPE_CHECKING:
    from robots import Robot
    from runtime.transports.ros.middleware import Quality


class RosSink(Sink):
    """Publisher of each command on all its topics, which waits for no subscriber; topics of the simulation come first.

    The `stamp` of a message is the time of the command, in ROS time, which is this machine's wall clock.
    """

    def __init__(
        self,
        robot: Robot,
        outlets: tuple[CommandTopic, ...],
        quality: Callable[[str], Quality],
        clock: Clock,
        wire: Wire,
        open_middleware: Callable[[], Middleware],
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self._robot, self._outlets, self._quality = robot, outlets, quality
        self._clock, self._wire, self._open, self._wall = clock, wire, open_middleware, wall
        self._posed = any(outlet.message == "PoseStamped" for outlet in outlets)
        self._middleware: Middleware | None = None
        self._publish: list[tuple[CommandTopic, Publish]] = []

    def connect(self) -> None:
        """Advertise every topic. Subscribers that start later connect by themselves."""
        self.close()
        self._middleware = middleware = self._open()
        self._publish = [
            (outlet, middleware.advertise(Topic(outlet.topic, outlet.message, self._quality(outlet.topic))))
            for outlet in self._outlets
        ]

    def send(self, command: RobotCommand) -> None:
        """Publish one absolute target.

        Raises TransportError for a wrong width, numbers that are not finite, or missing poses.
        """
        if self._middleware is None:
            raise TransportError("the command topics are not advertised; connect before sending")
        action = _finite(command.action, self._robot.dim, "a command").astype(np.float64)
        eef = None
        if self._posed:
            if command.eef is None:
                raise TransportError(
                    'transport.eef_commands = true, but the command has no poses; needed: publication.space = "eef"'
                )
            width = EEF_WIDTH * len(self._robot.arms)
            eef = _finite(command.eef, width, "a command's poses").astype(np.float64).reshape(-1, EEF_WIDTH)
        # `command.time` is on our monotonic clock; the stamp is the wall clock at the same moment.
        stamp = self._wall() - round((self._clock.now() - command.time) * 1e9)
        # Encode all messages before sending the first: a command reaches every group or none.
        messages = [
            self._wire.encode(self._message(outlet, stamp, action, eef)) for outlet, _ in self._publish
        ]
        for (_, publish), payload in zip(self._publish, messages, strict=True):
            publish(payload)

    def missing_subscribers(self) -> dict[str, str]:
        """Return the command topics that lack a subscriber, each with the reason ("" if the reason is unknown).

        A topic counts if it has no subscriber at all, or if one of its subscribers was refused.
        """
        matches = {} if self._middleware is None else self._middleware.matches()
        return {topic: match.refused for topic, match in matches.items() if not match.peers or match.refused}

    def close(self) -> None:
        """Close the publishers of all topics."""
        self._publish = []
        if self._middleware is not None:
            self._middleware.close()
            self._middleware = None

    def _message(
        self, outlet: CommandTopic, stamp: int, action: np.ndarray, eef: np.ndarray | None
    ) -> Message:
        if outlet.message == "JointState":
            return JointState(stamp, "", outlet.joints, action[list(outlet.dims)])
        assert eef is not None
        return PoseStamped(stamp, outlet.frame, eef[outlet.arm, [0, 1, 2, 4, 5, 6, 3]])


def _finite(numbers: Float32, width: int, label: str) -> Float32:
    vector = np.asarray(numbers, np.float32)
    if vector.shape != (width,) or not np.isfinite(vector).all():
        raise TransportError(
            f"{label} of shape {list(vector.shape)} {vector.tolist()} was to be sent; "
            f"allowed: {width} finite numbers"
        )
    return vector
