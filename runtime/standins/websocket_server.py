"""Common parts of websocket stand-ins: listening on loopback, serving connections, faults on demand."""

from __future__ import annotations

import contextlib
import http
import os
import socket
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.server import Server, ServerConnection, serve

from runtime.core.errors import SetupError
from runtime.core.types import Float32
from runtime.standins.faults import TOO_LARGE, Fault

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

_LATE = 3.0  # [s] default delay of the fault "late_reply"
Frames = str | bytes
Answering = Callable[[str | bytes], Frames | None]
"""Function of a request: its answer, None to leave it unanswered."""


class WebsocketServer(ABC):
    """Websocket server in threads of its own; one inference at a time, as on one GPU.

    If a request cannot be answered, the client receives a traceback as text, followed by close code 1011.
    """

    says_well = False  # whether GET /healthz is answered with 200
    speaks_first = True  # whether a connection begins with a frame of the server's

    def __init__(self, name: str, fault: Fault, port: int = 0, idle: float | None = None) -> None:
        self._name = name
        self._fault = fault
        self._port = port
        self._idle = idle  # [s] silence after which a connection is closed, None for never
        self._device = threading.Lock()
        self._asked = 0
        self._before: Frames = b""  # the newest answer
        self._server: Server | None = None
        self._thread: threading.Thread | None = None

    @abstractmethod
    def greeting(self) -> Frames | None:
        """Return the first frame of a connection; None to refuse it, after which it is closed."""

    @abstractmethod
    def begin(self) -> Answering:
        """Return a function that answers the requests of one connection."""

    def serves_path(self, path: str) -> bool:
        """Return True if a policy is served at this path."""
        return True

    def start(self) -> dict[str, object]:
        """Listen; return the address.

        Raises:
            SetupError: If the port is in use.
        """
        try:
            self._server = serve(
                self._converse,
                "127.0.0.1",
                self._port,
                process_request=self._admit,
                compression=None,
                max_size=None,
                ping_interval=None,
                close_timeout=1.0,
            )
        except OSError as error:
            raise SetupError(f"cannot listen at 127.0.0.1:{self._port}: {error}") from error
        self._port = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, name=self._name, daemon=True)
        self._thread.start()
        return {"url": f"ws://127.0.0.1:{self._port}", "port": self._port}

    def close(self) -> None:
        """Stop listening; safe to call twice."""
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._thread.join()
        self._server = self._thread = None

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        if self.says_well and request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        if self._fault.name == "http_404" or not self.serves_path(request.path):
            return connection.respond(http.HTTPStatus.NOT_FOUND, "there is no policy here\n")
        return None

    def _converse(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed, TimeoutError):
            if self._fault.name == "text_first":
                connection.send("the checkpoint could not be loaded")
            elif self.speaks_first and self._fault.name != "mute_on_connect":
                first = self.greeting()
                connection.send(first if first is not None else self.refusal())
                if first is None:
                    return
            answer = self.begin()
            while True:
                if not self._answer(connection, answer, connection.recv(timeout=self._idle)):
                    return

    def on_answered(self, answer: Answering, seconds: float) -> None:  # noqa: B027  # most keep no account of it
        """Do something after a reply was sent, `seconds` [s] after its request; the default does nothing.

        `answer` is the function that answers the requests of the connection.
        """

    def refusal(self) -> Frames:
        """Return the frame that is sent to a connection that is refused."""
        return "nothing is served here"

    def _answer(self, connection: ServerConnection, answer: Answering, request: str | bytes) -> bool:
        """Answer one request, correctly or as the fault demands; return False if the connection has ended."""
        started = time.monotonic()
        with self._device:
            number, self._asked = self._asked, self._asked + 1
            try:
                if self._fault.name == "exception":
                    raise RuntimeError("CUDA out of memory (on purpose)")
                reply = answer(request)
            except Exception as error:  # any error of a policy is reported to the client
                return self.failed(connection, error, request)
        if reply is None:
            return True
        if self._fault.name == "mute_on_infer" and number >= self._fault.number(0):
            return True
        if not self._send(connection, reply, number):
            return False
        self.on_answered(answer, time.monotonic() - started)
        return True

    def failed(self, connection: ServerConnection, error: Exception, request: Frames) -> bool:
        """Report an error to the client; return False if the connection is then closed."""
        connection.send(self.failure("".join(traceback.format_exception(error)), request))
        connection.close(1011, "Internal server error. Traceback included in previous frame.")
        return False

    def failure(self, traceback: str, request: Frames) -> Frames:
        """Return the frame that reports an error in a request."""
        return traceback

    def _send(self, connection: ServerConnection, reply: Frames, number: int) -> bool:
        fault = self._fault
        due = number >= fault.number(0) if fault.name != "action_mode" else False
        if fault.name == "die" and due:
            os._exit(1)
        if fault.name == "close_mid_reply" and due:
            _send_half(connection, reply)
            return False
        if fault.name == "late_reply" and number == 1:
            time.sleep(fault.number(_LATE))
        if fault.name == "too_large":
            reply = bytes(TOO_LARGE)
        if fault.name == "doubled_late" and number == fault.number(0) + 1:
            connection.send(self._before)
        connection.send(reply)
        if fault.name == "doubled" and number == fault.number(0):
            connection.send(reply)
        self._before = reply
        return True


def apply_fault(fault: Fault, actions: Float32) -> Any:
    """Return rows [T, D], modified by the fault."""
    name = fault.name
    if name == "nan":
        actions[min(3, len(actions) - 1), 2] = np.nan
    shapes = {
        "wrong_dim": actions[:, :-1],
        "empty": actions[:0],
        "batched": actions[None],
        "two_batches": np.stack([actions, actions]),
        "single_row": actions[0],
    }
    if name == "bad_array_dialect":
        kind, data = actions.dtype.str, actions.tobytes()
        return {b"nd": True, b"type": kind, b"kind": b"", b"shape": list(actions.shape), b"data": data}
    if name == "object_array":
        return {b"__ndarray__": True, b"data": b"\x80\x04N.", b"dtype": "|O", b"shape": [1]}
    return shapes.get(name, actions)


def _send_half(connection: ServerConnection, reply: Frames) -> None:
    """Send half a frame and end the TCP connection, as after a crash of the server."""
    payload = reply.encode() if isinstance(reply, str) else reply
    raw = Frame(Opcode.BINARY, payload).serialize(mask=False)
    connection.socket.sendall(raw[: len(raw) // 2])
    connection.socket.shutdown(socket.SHUT_RDWR)
