"""Leader over ZMQ that publishes its joints, to which we subscribe; single frames, openpi's arrays.

A message is a map: `t`, its own clock [s], and `state`, joints by the robot's groups, in the form of an execution node.
The protocol has no authentication, so an endpoint beyond this machine needs `insecure_link`.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
import zmq
from pydantic import model_validator

from runtime.core import msgpack_arrays
from runtime.core.clock import Clock
from runtime.core.errors import CodecError, ConfigurationError, TransportError
from runtime.core.node_sockets import is_loopback
from runtime.core.settings import Settings
from runtime.teleoperators.base import Leader, joints_from_state
from runtime.transports import node_link
from runtime.transports.node_link import Endpoint

if TYPE_CHECKING:
    from robots import Robot

_WAKE_MS = 50  # time until the reader thread notices that it must end [ms]
_REOPEN_S = 0.5
_LIMIT = 64 * 1024  # [bytes] per message


class Config(Settings):
    """A leader that publishes its joints over ZMQ."""

    kind: Literal["zmq"] = "zmq"
    endpoint: Endpoint = "tcp://127.0.0.1:5560"
    """ZMQ endpoint at which the leader publishes."""
    insecure_link: bool = False
    """Allow an endpoint beyond this machine, although anyone on that network can drive the robot."""

    @model_validator(mode="after")
    def _stay_on_this_machine(self) -> Config:
        if not self.insecure_link and not is_loopback(self.endpoint):
            raise ConfigurationError(
                f"collection.leader.endpoint = {self.endpoint!r} leaves this machine over a plain link; "
                "allowed: a loopback address, or insecure_link = true on a network you trust"
            )
        return self


def build(config: Config, robot: Robot, clock: Clock) -> ZmqLeader:
    """Create the leader, not yet connected."""
    return ZmqLeader(config.endpoint, robot, clock)


class ZmqLeader(Leader):
    """Leader whose messages a thread receives on a SUB socket, which keeps only the newest message.

    A message with the `t` of its predecessor is not new: a publisher that only repeats itself counts as silent.
    """

    def __init__(self, endpoint: str, robot: Robot, clock: Clock) -> None:
        super().__init__(robot, clock)
        self._endpoint = endpoint
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._stamp = math.nan

    @property
    def name(self) -> str:
        return f"the leader at {self._endpoint}"

    def connect(self) -> None:
        self.close()
        self._forget()
        self._stamp = math.nan
        self._ending.clear()
        try:
            socket = self._open_subscriber()
        except zmq.ZMQError as error:
            raise TransportError(f"cannot listen to {self.name}: {error}") from error
        self._thread = threading.Thread(target=self._read, args=(socket,), name="leader", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _open_subscriber(self) -> zmq.Socket[bytes]:
        options: dict[int, int | bytes] = {
            zmq.CONFLATE: 1,
            zmq.MAXMSGSIZE: _LIMIT,
            zmq.SUBSCRIBE: b"",
        }
        return node_link.open_socket(zmq.SUB, self._endpoint, options)

    def _read(self, socket: zmq.Socket[bytes] | None) -> None:
        """Run the reader thread. No error may end it, because nothing else listens to the leader."""
        while not self._ending.is_set():
            try:
                if socket is None:
                    socket = self._open_subscriber()
                if socket.poll(_WAKE_MS):
                    self.handle_message(socket.recv())
            except zmq.ZMQError as error:
                self._refuse(f"the socket failed and is opened anew: {error}")
                if socket is not None:
                    socket.close()
                    socket = None
                self._ending.wait(_REOPEN_S)
        if socket is not None:
            socket.close()

    def handle_message(self, payload: bytes) -> None:
        """Process one message; an unusable message becomes the leader's `problem`."""
        try:
            stamp, joints = self._parse(payload)
        except CodecError as error:
            self._refuse(str(error))
            return
        if stamp != self._stamp:
            self._stamp = stamp
            self._set_pose(joints, self._capture_time(stamp))

    def _capture_time(self, stamp: float) -> float:
        """Return the time of a pose on this clock [s]: its arrival, because the leader's clock is another."""
        return self._clock.now()

    def _parse(self, payload: bytes) -> tuple[float, np.ndarray]:
        message = msgpack_arrays.unpack(payload, _LIMIT)
        if not isinstance(message, dict):
            raise CodecError(f"the leader's message is a {type(message).__name__}; expected a map")
        stamp, state = message.get("t"), message.get("state")
        if isinstance(stamp, bool) or not isinstance(stamp, int | float) or not math.isfinite(stamp):
            raise CodecError(f"the leader's t is {stamp!r:.80}; expected seconds of its clock")
        if not isinstance(state, Mapping) or not all(
            isinstance(part, np.ndarray) and part.dtype.kind == "f" for part in state.values()
        ):
            raise CodecError("the leader's state is no map of float arrays by group")
        return float(stamp), joints_from_state(state, self._robot)
