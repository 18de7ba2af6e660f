"""Websocket server of a station as a robot: one msgpack map per request, one per answer.

A request has `do`: `describe`, `begin`, `observe`, `act`, `end` or `watch`. An answer that has `error` is a refusal; if
`over` is true, the run has ended. Arrays are those of execution nodes (`runtime.core.msgpack_arrays`). One program
drives; others may watch.
"""

from __future__ import annotations

import contextlib
import hmac
import http
import logging
import re
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.protocol import State
from websockets.sync.server import Server, ServerConnection, serve

from runtime.clients.listener import limit_sending
from runtime.clients.robot_server.session import DRIVERS, DriveSession, SessionError
from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError, RuntimeFault

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

log = logging.getLogger(__name__)
_LARGEST = 1 << 20  # [bytes] of a request
_CLOSE_S = 2.0
_END_S = 10.0  # for the end of a run when this process ends [s]; later its lease ends it
_PING_S = 5.0
MOST_CLIENTS = 8
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]*")


class RobotServer:
    """Server of one station; each connection has a thread of its own, and the station's lease decides who drives.

    Args:
        token: What the address needs (`?token=`).
        make_session: Function of a program's name: a session of its own.
        watch: Function that returns the newest joints of the station. Raises RuntimeFault.
        silence_s: Longest time between two requests during a run [s].
    """

    def __init__(
        self,
        token: str,
        make_session: Callable[[str], DriveSession],
        watch: Callable[[], Mapping[str, Any]],
        silence_s: float,
    ) -> None:
        self._token = token
        self._make_session = make_session
        self._watch = watch
        self._silence_s = silence_s
        self._lock = threading.Lock()
        self._connections: dict[int, tuple[ServerConnection, threading.Thread]] = {}
        self._server: Server | None = None

    def open(self, host: str, port: int, context: ssl.SSLContext | None = None) -> int:
        """Listen in threads, and return the port. Raises: OSError."""
        self._server = serve(
            self._converse,
            host,
            port,
            ssl=context,
            process_request=self._admit,
            max_size=_LARGEST,
            compression=None,
            close_timeout=_CLOSE_S,
            ping_interval=_PING_S,
            ping_timeout=2 * _PING_S,
        )
        threading.Thread(target=self._server.serve_forever, name="robot-server", daemon=True).start()
        return int(self._server.socket.getsockname()[1])

    def close(self) -> None:
        """Stop listening, and end all connections and their runs."""
        if self._server is not None:
            self._server.shutdown()
        with self._lock:
            remaining = list(self._connections.values())
        for connection, _ in remaining:
            with contextlib.suppress(OSError):  # it has ended meanwhile
                connection.socket.shutdown(socket.SHUT_RDWR)
        until = time.monotonic() + _END_S
        for _, thread in remaining:
            thread.join(max(0.0, until - time.monotonic()))

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse a client without the token, every page of a browser, and too many clients."""
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if not hmac.compare_digest(given.encode(), self._token.encode()):
            return connection.respond(
                http.HTTPStatus.UNAUTHORIZED, "the address needs ?token=..., as the robot server prints it\n"
            )
        if "Origin" in request.headers:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "pages of a browser cannot drive a robot\n")
        with self._lock:
            if len(self._connections) >= MOST_CLIENTS:
                return connection.respond(
                    http.HTTPStatus.SERVICE_UNAVAILABLE, f"at most {MOST_CLIENTS} programs\n"
                )
        return None

    def _converse(self, connection: ServerConnection) -> None:
        with self._lock:
            number = next(n for n in range(MOST_CLIENTS + 1) if n not in self._connections)
            self._connections[number] = connection, threading.current_thread()
        conversation = Conversation(self._make_session, self._watch, lambda: connection.state is State.OPEN)
        limit_sending(connection.socket)
        try:
            while True:
                patience = self._silence_s if conversation.is_driving else None
                answer = conversation.answer(connection.recv(patience))
                with conversation.sending():
                    connection.send(answer)
        except TimeoutError:
            log.warning("%s has sent nothing for %g s: its run ends", conversation.program, self._silence_s)
            connection.close(1008, f"nothing was sent for {self._silence_s:g} s")
        except (ConnectionClosed, OSError) as error:
            log.info("the connection of %s has ended: %s", conversation.program or "a program", error)
        finally:
            conversation.close()
            with self._lock:
                del self._connections[number]


class Conversation:
    """Answers to the requests of one connection; `is_driving` is True from the first `begin` on."""

    def __init__(
        self,
        make_session: Callable[[str], DriveSession],
        watch: Callable[[], Mapping[str, Any]],
        is_connected: Callable[[], bool],
    ) -> None:
        self._make_session = make_session
        self._watch = watch
        self._is_connected = is_connected
        self._session: DriveSession | None = None
        self._sent: dict[str, float] = {}  # capture time of the newest picture that was sent, by camera
        self.program = ""
        self.is_driving = False

    def answer(self, payload: str | bytes) -> bytes:
        """Return the answer to a request; a refusal has the key `error`."""
        try:
            return msgpack_arrays.pack(self._answer(_parse(payload)))
        except SessionError as error:
            return msgpack_arrays.pack(
                {"error": str(error), "over": error.is_over, "stopped": error.is_stopped}
            )
        except RuntimeFault as fault:  # of the station, or a request that cannot be read
            return msgpack_arrays.pack({"error": str(fault), "over": False})

    @contextlib.contextmanager
    def sending(self) -> Iterator[None]:
        """Note that an answer is being sent, for as long as the program does not read it."""
        session = self._session
        if session is not None:
            session.sending_since = time.monotonic()
        try:
            yield
        finally:
            if session is not None:
                session.sending_since = None

    def close(self) -> None:
        """End run and lease of this connection. Safe to call twice."""
        if self._session is not None:
            self._session.close("the program has gone")
        self._session = None

    def _answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        word = request.get("do")
        if not isinstance(word, str):
            raise SessionError(f"do is a {type(word).__name__}; expected a text")
        if word == "watch":
            return self._watch()
        if word == "describe":
            return self._get_session(request).describe()
        if word == "begin":
            self.is_driving = True
            self._sent = {}
            task, duration = _read_text(request, "task", 2000), _read_seconds(request, "duration_s")
            seed = request.get("seed")
            if seed is not None and type(seed) is not int:
                raise SessionError(f"seed = {seed!r:.100}; expected a whole number")
            driver = request.get("driver", "policy")
            if driver not in DRIVERS:
                raise SessionError(f"driver = {driver!r:.100}; allowed: {', '.join(DRIVERS)}")
            return self._get_session(request).begin(task, self._is_connected, duration, seed, driver)
        if word not in ("observe", "act", "end"):
            raise SessionError(f"request {word!r:.100}; allowed: describe, begin, observe, act, end, watch")
        if self._session is None:
            raise SessionError("no run has begun: begin one first", is_over=True)
        if word == "observe":
            return self._observe(self._session)
        if word == "act":
            self._session.act(request.get("row"))
            return {}
        return self._session.end()

    def _get_session(self, request: Mapping[str, Any]) -> DriveSession:
        if self._session is None:
            self.program = _read_text(request, "program", 60) or "a program"
            if not _NAME.fullmatch(self.program):
                raise SessionError(
                    f"program = {self.program!r}; allowed: letters, digits, spaces, dots and dashes"
                )
            self._session = self._make_session(self.program)
        return self._session

    def _observe(self, session: DriveSession) -> dict[str, Any]:
        """Return the newest observation; of the cameras only pictures that this program does not have yet."""
        newest = session.observe()
        times = newest.picture_times
        new = {key: image for key, image in newest.pictures.items() if times.get(key) != self._sent.get(key)}
        self._sent |= {key: times[key] for key in new if key in times}
        return {
            "step": newest.step,
            "task": newest.task,
            "captured": {**newest.captured, **newest.picture_times},
            "joints": newest.joints,
            "commanded": newest.commanded,
            "environment_state": newest.environment_state,
            "pictures": new,
        }


def _parse(payload: str | bytes) -> Mapping[str, Any]:
    if isinstance(payload, str):
        raise CodecError("the request is a text frame; expected a binary one, with a map in msgpack")
    request = msgpack_arrays.unpack(payload, _LARGEST)
    if not isinstance(request, dict):
        raise CodecError(f"the request is a {type(request).__name__}; expected a map")
    return request


def _read_text(request: Mapping[str, Any], key: str, longest: int) -> str:
    text = request.get(key) or ""
    if not isinstance(text, str) or len(text) > longest:
        raise SessionError(f"{key} = {text!r:.100}; expected a text of at most {longest} characters")
    return text


def _read_seconds(request: Mapping[str, Any], key: str) -> float | None:
    seconds = request.get(key)
    if seconds is not None and (type(seconds) not in (int, float) or not 0 < seconds < 1e6):
        raise SessionError(f"{key} = {seconds!r:.100}; expected seconds above 0")
    return seconds
