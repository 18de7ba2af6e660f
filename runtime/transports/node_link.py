"""ZMQ socket to an execution node, with the options that both directions need."""

from __future__ import annotations

from collections.abc import Mapping

import zmq

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
