"""Check whether a ZMQ socket has a message: ten times faster than the exception of an unsuccessful `recv`."""

from __future__ import annotations

from typing import Any

import zmq


def readable(socket: zmq.Socket[Any]) -> bool:
    """Return True if the socket has a message."""
    return bool(int(socket.get(zmq.EVENTS)) & zmq.POLLIN)
