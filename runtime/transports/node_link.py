"""A socket to an execution node, with what both directions need of it."""

from __future__ import annotations

from collections.abc import Mapping

import zmq

# A link that was cut without a word is given up after 4 s and made anew; else it is waited for up to 15 min.
_ALIVE = {
    zmq.LINGER: 0,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 1,
    zmq.TCP_KEEPALIVE_INTVL: 1,
    zmq.TCP_KEEPALIVE_CNT: 3,
}


def open_socket(kind: int, endpoint: str, options: Mapping[int, int | bytes]) -> zmq.Socket[bytes]:
    """A connected socket of that kind; raises ZMQError for an address that libzmq refuses."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    try:
        for option, value in (*_ALIVE.items(), *options.items()):
            socket.setsockopt(option, value)
        socket.connect(endpoint)
    except zmq.ZMQError:
        socket.close()
        raise
    return socket
