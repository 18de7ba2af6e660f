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
    """Endpoint of a node's observations, and their reception."""

    sub_endpoint: Endpoint = "tcp://127.0.0.1:5555"
    """ZMQ endpoint at which the node publishes observations."""
    encoding: Encoding = "bgr"
    """Colour order of the node's images; an `encoding` field in a message takes precedence."""
    disabled_cameras: list[str] = Field(default_factory=list)
    """Observation keys of cameras that this deployment does not use."""
    detect_frozen: bool = True
    """Whether an image identical to the previous one counts as not new; false for simulated cameras whose images may be
    constant."""
    stalled_after_s: float = Field(default=1.0, gt=0)
    """Time without a usable message after which the missing data are reported [s]."""
    simulated: bool = False
    """Whether the node is a simulated bench: the station may reset it, and accepts the ground truth that it reports."""
    bench: str = "tabletop"
    """Which bench it simulates: one that comes with the program, or the path of a bench's folder. Positions that the
    station is asked to lay out have to fit it."""


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
