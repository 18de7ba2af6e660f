"""Simulated node within the station's process, for lockstep: the same messages in both directions, without sockets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from runtime.core import msgpack_arrays
from runtime.core.clock import Clock
from runtime.core.types import Observation, RobotCommand, UInt8
from runtime.simulation.node import Node
from runtime.transports.base import Sink, Source
from runtime.transports.node_messages import MESSAGE_LIMIT, NodeMessages

if TYPE_CHECKING:
    from robots import Robot

_NAME = "lockstep"


class InProcessNode(Source, Sink):
    """Source and sink of a transport around a `Node` whose sockets are not opened.

    The node advances in `receive`: it executes the commands sent since the previous observation, then advances by the
    time that has passed. An observation therefore shows the effect of the commands of all earlier ticks. Messages pass
    through the codec, the node's command gate and the transport's message check, as with sockets.
    """

    def __init__(
        self,
        node: Node,
        robot: Robot,
        clock: Clock,
        seen: Callable[[Observation], None] = lambda observation: None,
    ) -> None:
        """Wrap `node`; `seen` is called with every observation, for example by a simulated leader."""
        self._node, self._clock, self._seen = node, clock, seen
        self._messages = NodeMessages(robot, "bgr", frozenset(), MESSAGE_LIMIT)
        self._commands: list[bytes] = []
        self._sequence = 0
        self._looked: float | None = None

    def connect(self) -> None:
        """Do nothing, because there is no connection."""

    def receive(self, timeout: float) -> Observation | None:
        """Return an observation of the node; None if no time has passed since the previous one. Never waits.

        Raises:
            MessageRefused: If the node's message is invalid, which would be a defect of the simulation.
        """
        now = self._clock.now()
        if self._looked is not None and now <= self._looked:
            return None
        seconds = 0.0 if self._looked is None else now - self._looked
        self._looked, self._sequence = now, self._sequence + 1
        commands, self._commands = self._commands, []
        frame = self._messages.read(self._node.exchange(commands, seconds))
        streams = ("joints", *(() if frame.eef is None else ("eef",)), *frame.pictures)
        observation = Observation(
            sequence=self._sequence,
            arrived=now,
            captured=MappingProxyType(dict.fromkeys(streams, frame.stamp)),
            qpos=frame.qpos,
            pictures={key: _rgb(bgr) for key, bgr in frame.pictures.items()},
            eef=frame.eef,
            truth=frame.truth,
            drives=frame.drives,
            environment_state=frame.environment_state,
        )
        self._seen(observation)
        return observation

    def send(self, command: RobotCommand) -> None:
        """Queue a command, which the node executes at the next `receive`."""
        self._queue_message(
            {"t": command.time, "target": "real", "action": command.action, "source": command.source}
        )

    def send_control_word(self, word: str, data: Mapping[str, Any]) -> None:
        """Queue a control word, which the node executes at the next `receive`."""
        self._queue_message({**data, "t": self._clock.now(), "target": word})

    def close(self) -> None:
        """Release the node's resources."""
        self._node.close()

    def _queue_message(self, message: dict[str, Any]) -> None:
        self._commands.append(msgpack_arrays.pack(message | {"master": _NAME}))


def _rgb(bgr: UInt8) -> UInt8:
    """Convert a node's BGR image to RGB."""
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
