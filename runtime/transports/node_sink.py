"""Sink of commands to an execution node over ZMQ."""

from __future__ import annotations

import contextlib
import uuid
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import zmq

from runtime.core import msgpack_arrays
from runtime.core.clock import Clock
from runtime.core.errors import TransportError
from runtime.core.types import Float32, RobotCommand
from runtime.transports import node_link
from runtime.transports.base import Sink

if TYPE_CHECKING:
    from robots import Robot

_QUEUED_COMMANDS = 2
_QUEUED_BYTES = 8 * 1024  # in the kernel: a node that was stopped finds at most this much when it continues
# Control words that every node may know. Their messages have the fields of a command, which older nodes require.
_FORMED = frozenset({"collect_start", "collect_stop", "hil_start", "hil_stop"})


class NodeSink(Sink):
    """PUB socket for commands. A message that cannot be sent at once is dropped; nothing waits for an absent node.

    Each message names its sender (`master`, one id per sink) and its number (`seq`); older nodes ignore both. With
    `says_source` a command says what drives the robot by it: a bench may advance by the rows of a policy alone, and a
    device is not connected under the e-stop.
    """

    def __init__(self, endpoint: str, robot: Robot, clock: Clock, says_source: bool = False) -> None:
        self._endpoint = endpoint
        self._dim = robot.dim
        self._clock = clock
        self._says_source = says_source
        self._socket: zmq.Socket[bytes] | None = None
        self._sequence = 0
        self._newest: Float32 = np.zeros(robot.dim, np.float32)  # the last command that was sent
        self.master = uuid.uuid4().hex

    def connect(self) -> None:
        """Open the socket. ZMQ connects to the node as soon as it is there."""
        self.close()
        options: dict[int, int | bytes] = {
            zmq.SNDHWM: _QUEUED_COMMANDS,
            zmq.SNDBUF: _QUEUED_BYTES,
            # Without this, ZMQ queues commands for an absent node and sends it the oldest when it comes back.
            zmq.IMMEDIATE: 1,
        }
        try:
            self._socket = node_link.open_socket(zmq.PUB, self._endpoint, options)
        except zmq.ZMQError as error:
            raise TransportError(f"cannot reach the node at {self._endpoint}: {error}") from error

    def send(self, command: RobotCommand) -> None:
        """Send one absolute target. Raises TransportError for a wrong shape or numbers that are not finite."""
        action = np.asarray(command.action, dtype=np.float32)
        if action.shape != (self._dim,) or not np.isfinite(action).all():
            raise TransportError(
                f"a command of shape {list(action.shape)} {action.tolist()} was to be sent; "
                f"allowed: {self._dim} finite numbers"
            )
        source = {"source": command.source} if self._says_source else {}
        self._send({"t": float(command.time), "action": action, "target": "real", **source})
        self._newest = action

    def send_control_word(self, word: str, data: Mapping[str, Any]) -> None:
        """Send the control word `word` as the target of a message, with `data` as further fields.

        Words that older nodes know also carry an action vector, which those nodes require: the newest command, or zeros
        before the first.
        """
        reserved = sorted({"t", "target", "action", "master", "seq"} & set(data))
        if reserved or word in ("real", "sim"):
            raise TransportError(f"the control word {word!r} with {reserved} would be taken for a command")
        form = {"action": self._newest} if word in _FORMED else {}
        self._send({"t": self._clock.now(), **form, "target": word, **data})

    def _send(self, message: dict[str, Any]) -> None:
        if self._socket is None:
            raise TransportError(f"the link to {self._endpoint} is not connected; connect it before sending")
        self._sequence += 1
        message |= {"master": self.master, "seq": self._sequence}
        with contextlib.suppress(zmq.Again):  # only the newest command counts; the next follows in a tick
            self._socket.send(msgpack_arrays.pack(message), zmq.NOBLOCK)

    def close(self) -> None:
        """Close the socket and drop messages that have not been sent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
