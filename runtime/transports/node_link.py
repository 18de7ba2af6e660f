"""ZMQ socket to an execution node, with the options that both directions need."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import zmq
from pydantic import Field

from runtime.core.settings import Settings
from runtime.transports.node_messages import Encoding

Endpoint = Annotated[str, Field(pattern=r"^(tcp|ipc|inproc)://.+")]


class NodeSettings(Settings):
    """Publisher of a node's observations, and their reception."""

    sub_endpoint: Endpoint = "tcp://127.0.0.1:5555"
    """Where the node publishes observations."""
    encoding: Encoding = "bgr"
    """Colour order of the node's pictures; an `encoding` field on the wire wins."""
    disabled_cameras: list[str] = Field(default_factory=list)
    """Observation keys of cameras that this deployment does without."""
    detect_frozen: bool = True
    """A picture exactly like the one before counts as no newer; off for simulated cameras that may stand still."""
    stalled_after_s: float = Field(default=1.0, gt=0)
    """How long without a usable message until it is said what is missing [s]."""
    simulated: bool = False
    """The node is a simulated bench: it may be reset by us, and what it says is the truth of it is believed."""


# A connection that was cut silently is dropped after 4 s and opened again; the kernel's default may be 15 min.
_ALIVE = {
    zmq.LINGER: 0,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 1,
    zmq.TCP_KEEPALIVE_INTVL: 1,
    zmq.TCP_KEEPALIVE_CNT: 3,
}


def open_socket(kind: int, endpoint: str, options: Mapping[int, int | bytes]) -> zmq.Socket[bytes]:
    """Return a connected socket of the given ZMQ type. Raises ZMQError for an address that libzmq refuses."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    try:
        for option, value in (*_ALIVE.items(), *options.items()):
            socket.setsockopt(option, value)
        socket.connect(endpoint)
    except zmq.ZMQError:
        socket.close()
        raise
    return socket
