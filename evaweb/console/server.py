"""Web server process: Daphne and a background service, ended by a signal or by its lifeline."""

from __future__ import annotations

import json
import os
import resource
import socket
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any, Protocol

from daphne.server import Server, twisted_loop  # must come first: it selects the reactor

# isort: split
from autobahn.exception import Disconnected
from twisted.internet import reactor, task

from evaweb.console.connection_limits import ConnectionLimiter, LimitedFactory, Request
from evaweb.console.reading import until_read
from evaweb.console.websocket_limits import LimitedWebSocket
from evaweb.core.lock_wait import limit_page_waits

_ACCEPTED = 16  # connections accepted per turn of the event loop
_MOST_WAITING = 4096  # connections without a whole request, unless a quarter of the file limit is less
_SWEEP_S = 1.0
_THREADS = 16  # threads for database queries of live pages
_LAST_S = 4.0  # grace period for requests in progress before the process exits
_LARGEST_REQUEST = (
    2 * 1024 * 1024
)  # [bytes] over a websocket, the same as over REST: a press may carry any reason
_TURN_S = (
    0.001  # switch interval of the interpreter: an e-stop needs several switches, of 5 ms each by default
)


class BackgroundService(Protocol):
    """Service that runs beside the server for as long as the process serves."""

    def start(self) -> None:
        """Start the service; called when the process has begun to serve."""

    def end(self) -> None:
        """Stop the service."""


def serve(
    application: Any,
    listener: socket.socket,
    *,
    beside: BackgroundService | None,
    lifeline: bool,
    request: type[Request] = Request,
    nice: int = 0,
) -> None:
    """Serve until SIGINT, SIGTERM or, with `lifeline`, the end of standard input; print the address as JSON.

    Args:
        application: ASGI application.
        listener: Listening socket, which belongs to the server from then on.
        beside: Service that is started and stopped with the server, None for no such service.
        lifeline: Whether to stop at the end of standard input.
        request: Class of the requests.
        nice: Niceness added once serving has begun. Starting takes seconds of processor time, which would become half a
            minute at low priority on a busy machine.
    """
    sys.setswitchinterval(_TURN_S)
    address = _address(listener)
    arrivals = _arrivals(raise_file_limit())
    limit_page_waits()
    twisted_loop.set_default_executor(ThreadPoolExecutor(_THREADS, "page"))
    server = _Server(
        partial(LimitedFactory, arrivals=arrivals, request=request),
        arrivals,
        application,
        endpoints=[f"fd:fileno={listener.detach()}"],  # the descriptor belongs to Twisted from here on
        websocket_max_message_size=_LARGEST_REQUEST,
        websocket_max_frame_size=_LARGEST_REQUEST,
        server_name="eva",
    )
    events: Any = reactor
    if beside is not None:
        events.callWhenRunning(beside.start)
    events.callWhenRunning(set_nice, nice)
    events.callWhenRunning(lambda: print(json.dumps(address), flush=True))
    events.addSystemEventTrigger("before", "shutdown", _exit_after_grace)
    if beside is not None:
        events.addSystemEventTrigger("before", "shutdown", beside.end)
    if lifeline:
        threading.Thread(target=_watch, args=(server,), name="lifeline", daemon=True).start()
    server.run()


class _Server(Server):
    def __init__(self, entrance: Any, arrivals: ConnectionLimiter, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._entrance, self._arrivals = entrance, arrivals

    async def handle_reply(self, protocol: Any, message: Any) -> None:
        """Send a part of an answer; return when its next part may be produced.

        What is sent to a page that has just left is dropped: the consumer is told so by a message of its own.
        """
        with suppress(Disconnected):
            await super().handle_reply(protocol, message)
        if message["type"] == "http.response.body" and message.get("more_body"):
            await until_read(protocol)

    def listen_success(self, port: Any) -> None:
        """Replace the protocol factory of the listening port by one that applies this project's limits.

        Daphne calls this method after it has started to listen with its own factory.
        """
        super().listen_success(port)
        port.factory = self._entrance(port.factory)
        self.ws_factory.protocol = LimitedWebSocket

        def few_at_once() -> None:
            port.numberAccepts = _ACCEPTED  # Twisted raises it while more connections wait
            type(port).doRead(port)

        port.doRead = few_at_once
        task.LoopingCall(self._arrivals.close_expired).start(_SWEEP_S)


def set_nice(nice: int) -> None:
    """Raise the niceness of all threads of this process, and of the threads that they start, by `nice`."""
    for thread in map(int, os.listdir("/proc/self/task")):
        with suppress(ProcessLookupError):  # the thread has ended
            os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + nice)


def raise_file_limit() -> int:
    """Raise the limit of open files and connections to the hard limit; return it."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return hard


def _arrivals(files: int) -> ConnectionLimiter:
    most = min(_MOST_WAITING, max(16, files // 4))
    return ConnectionLimiter(most, most // 2)


def _address(listener: socket.socket) -> dict[str, Any]:
    host, port = listener.getsockname()[:2]
    displayed = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return {"url": f"http://{displayed}:{port}", "host": host, "port": port}


def _watch(server: Server) -> None:
    """Stop the server when standard input ends: the parent process holds its other end."""
    while os.read(0, 4096):
        pass
    events: Any = reactor
    events.callFromThread(server.stop)


def _exit_after_grace() -> None:
    """Exit the process after a grace period, however many threads are still running.

    A thread that waits for the database or a station cannot be interrupted.
    """
    last = threading.Timer(_LAST_S, os._exit, (1,))
    last.daemon = True
    last.start()
