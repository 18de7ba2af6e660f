"""The web process: daphne in this process, with the chronicle beside it, ended by signal or lifeline."""

from __future__ import annotations

import json
import os
import socket
import threading
from typing import Any

from daphne.server import Server  # first: it decides which reactor there is

# isort: split
from twisted.internet import reactor

from evaweb.console.chronicle import Chronicle
from evaweb.errors import EvaError

_BACKLOG = 128
_LAST_S = 4.0  # for requests that are under way, before the process ends all the same
_LARGEST_REQUEST = 64 * 1024  # bytes over a websocket; a page says little


class PortTaken(EvaError):
    """Something else listens there already."""


def listen(host: str, port: int) -> socket.socket:
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


def serve(application: Any, listener: socket.socket, *, lifeline: bool) -> None:
    """Serve until SIGINT, SIGTERM or, with `lifeline`, the end of standard input; prints where as JSON."""
    address = _address(listener)
    server = Server(
        application,
        endpoints=[f"fd:fileno={listener.detach()}"],  # which is Twisted's from now on
        websocket_max_message_size=_LARGEST_REQUEST,
        websocket_max_frame_size=_LARGEST_REQUEST,
        server_name="eva",
    )
    chronicle = Chronicle()
    events: Any = reactor
    events.callWhenRunning(lambda: print(json.dumps(address), flush=True))
    events.callWhenRunning(chronicle.start)
    events.addSystemEventTrigger("before", "shutdown", _end_for_sure)
    events.addSystemEventTrigger("before", "shutdown", chronicle.end)
    if lifeline:
        threading.Thread(target=_watch, args=(server,), name="lifeline", daemon=True).start()
    server.run()


def _address(listener: socket.socket) -> dict[str, Any]:
    host, port = listener.getsockname()[:2]
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return {"url": f"http://{shown}:{port}", "host": host, "port": port}


def _watch(server: Server) -> None:
    """Whoever started us holds the other end of our standard input."""
    while os.read(0, 4096):
        pass
    events: Any = reactor
    events.callFromThread(server.stop)


def _end_for_sure() -> None:
    """A thread that waits for the database or a station cannot be interrupted; it must not keep us."""
    last = threading.Timer(_LAST_S, os._exit, (1,))
    last.daemon = True
    last.start()
