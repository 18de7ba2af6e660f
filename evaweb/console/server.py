"""A process of the web: daphne in this process, with what it does beside, ended by signal or lifeline."""

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

from daphne.server import Server, twisted_loop  # first: it decides which reactor there is

# isort: split
from twisted.internet import reactor, task

from evaweb.console.arrivals import ConnectionLimiter, LimitedFactory, Request
from evaweb.console.reading import until_read
from evaweb.console.sockets import LimitedWebSocket
from evaweb.lock_wait import limit_page_waits

_ACCEPTED = 16  # connections that are taken up in one turn of the loop
_MOST_WAITING = 4096  # connections without a whole request, where a quarter of all files is as many
_SWEEP_S = 1.0
_THREADS = 16  # for what live pages ask the database
_LAST_S = 4.0  # for requests that are under way, before the process ends all the same
_LARGEST_REQUEST = 2 * 1024 * 1024  # bytes over a websocket, as over REST: a press may say whatever it likes
_TURN_S = 0.001  # of the interpreter, where others wait for it: an e-stop takes several, and each is 5 ms by default


class BackgroundService(Protocol):
    """Service of a process, for as long as the process serves."""

    def start(self) -> None:
        """It serves."""

    def end(self) -> None:
        """It ends."""


def serve(
    application: Any,
    listener: socket.socket,
    *,
    beside: BackgroundService | None,
    lifeline: bool,
    request: type[Request] = Request,
    nice: int = 0,
) -> None:
    """Serve until SIGINT, SIGTERM or, with `lifeline`, the end of standard input; prints where as JSON.

    Not until then it gives way to others by `nice`: a start takes seconds of the processor, and a busy machine gives
    one that gives way half a minute for them.
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
        endpoints=[f"fd:fileno={listener.detach()}"],  # which is Twisted's from now on
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
        """Hand a part of an answer on; done once its next piece may be made."""
        await super().handle_reply(protocol, message)
        if message["type"] == "http.response.body" and message.get("more_body"):
            await until_read(protocol)

    def listen_success(self, port: Any) -> None:
        """Daphne makes its own factory and listens with it: ours stands before it from now on."""
        super().listen_success(port)
        port.factory = self._entrance(port.factory)
        self.ws_factory.protocol = LimitedWebSocket

        def few_at_once() -> None:
            port.numberAccepts = _ACCEPTED  # which Twisted raises as long as there are more
            type(port).doRead(port)

        port.doRead = few_at_once
        task.LoopingCall(self._arrivals.close_expired).start(_SWEEP_S)


def set_nice(nice: int) -> None:
    """Have all threads of this process that there are, and those that they start, be nicer by so much."""
    for thread in map(int, os.listdir("/proc/self/task")):
        with suppress(ProcessLookupError):  # it has ended
            os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + nice)


def raise_file_limit() -> int:
    """As many open files and connections as the system lets this process have; how many."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return hard


def _arrivals(files: int) -> ConnectionLimiter:
    most = min(_MOST_WAITING, max(16, files // 4))
    return ConnectionLimiter(most, most // 2)


def _address(listener: socket.socket) -> dict[str, Any]:
    host, port = listener.getsockname()[:2]
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return {"url": f"http://{shown}:{port}", "host": host, "port": port}


def _watch(server: Server) -> None:
    """The process that started us holds the other end of our standard input."""
    while os.read(0, 4096):
        pass
    events: Any = reactor
    events.callFromThread(server.stop)


def _exit_after_grace() -> None:
    """A thread that waits for the database or a station cannot be interrupted; it must not keep us."""
    last = threading.Timer(_LAST_S, os._exit, (1,))
    last.daemon = True
    last.start()
