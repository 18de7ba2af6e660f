"""Listening sockets, opened by the server or by the lab, which keeps them open while the server restarts."""

from __future__ import annotations

import socket

from evaweb.core.errors import EvaError

_BACKLOG = 4096  # beyond it a client's connection attempt is repeated after a second


class PortInUseError(EvaError):
    """Error if it is impossible to listen on the address, usually because the port is in use."""


def open_listener(host: str, port: int, option: str = "--port") -> socket.socket:
    """Return a non-blocking listening TCP socket; port 0 picks a free port.

    Raises: PortInUseError with advice, which names the `option` of the port.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        raise PortInUseError(
            f"cannot listen on {host}:{port}: {error.strerror}; name another address with --host, or another port "
            f"with {option}"
        ) from None
    listener.setblocking(False)
    return listener
