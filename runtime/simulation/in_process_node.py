"""The simulated node within this process, for lockstep: its real messages both ways, and no sockets."""

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
    """Both halves of a transport around a node that is not opened.

    The node moves when it is looked at: it obeys what was sent since the last time, then lets that time pass. So
    an observation shows what came of the commands of all earlier ticks. Everything passes the codec, the node's
    own gate, and the check of its messages.
    """

    def __init__(
        self,
        node: Node,
        robot: Robot,
        clock: Clock,
        seen: Callable[[Observation], None] = lambda observation: None,
    ) -> None:
        """`seen` is given every observation too: somebody else looks at the bench."""
        self._node, self._clock, self._seen = node, clock, seen
        self._messages = NodeMessages(robot, "bgr", frozenset(), MESSAGE_LIMIT)
        self._commands: list[bytes] = []
        self._sequence = 0
        self._looked: float | None = None

    def connect(self) -> None:
        """There is nothing to open."""

    def receive(self, timeout: float) -> Observation | None:
        """Present observation of the node; None if no time has passed since the last one. It never waits.

        Raises MessageRefused for an invalid message: this node has no excuse.
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
        )
        self._seen(observation)
        return observation

    def send(self, command: RobotCommand) -> None:
        """The node obeys it when it is looked at next."""
        self._queue_message({"t": command.time, "target": "real", "action": command.action})

    def send_control_word(self, word: str, data: Mapping[str, Any]) -> None:
        """The same for a control word."""
        self._queue_message({**data, "t": self._clock.now(), "target": word})

    def close(self) -> None:
        """Release what the node has."""
        self._node.close()

    def _queue_message(self, message: dict[str, Any]) -> None:
        self._commands.append(msgpack_arrays.pack(message | {"master": _NAME}))


def _rgb(bgr: UInt8) -> UInt8:
    """A picture of a node as one of ours."""
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
