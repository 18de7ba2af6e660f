"""Sockets that listen, opened by the serving process, or by a lab that keeps one open while its server restarts."""

from __future__ import annotations

import socket

from evaweb.errors import EvaError

_BACKLOG = 4096  # a connection that finds no place tries again after a second


class PortTaken(EvaError):
    """Something else listens there already."""


def open_listener(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one. PortTaken says what to do."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        raise PortTaken(
            f"cannot listen on {host}:{port}: {error.strerror}; name another address or port with --host, --port"
        ) from None
    listener.setblocking(False)
    return listener
