"""Websocket to a policy server: a first frame on connect, then strictly one response to each request.

Most responses carry no id. A connection whose response is late is therefore dropped and never reused, and so is a
connection on which a message waits before a request is sent. Where they do carry one, `exchange_matched` skips those to
other requests.
"""

from __future__ import annotations

import contextlib
import json
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from runtime.core.errors import (
    PolicyDisconnected,
    PolicyError,
    PolicyLostError,
    PolicyTimeout,
    RefusedError,
    ServerReportedError,
    TlsError,
    UnsolicitedError,
    WrongProtocolError,
)
from runtime.core.sentences import Pattern, fixed
from runtime.core.tls import allow_two_threads
from runtime.policies.connection import Dial, Place, open_connection
from runtime.policies.watchdog import Watchdog

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

Answer = TypeVar("Answer")

_ITS_METADATA = fixed("policy.server.its_metadata", "its metadata")
_NOT_CONNECTED = Pattern("policy.server.not_connected", "there is no connection to {url}; connect first")
_AN_ANSWER = fixed("policy.server.an_answer", "an answer")
_AN_ACKNOWLEDGEMENT = fixed("policy.server.an_acknowledgement", "an acknowledgement")
_CLOSED_BY_US = Pattern("policy.server.closed_by_us", "the connection to {url} was closed from our side")
_NO_ADDRESS = Pattern("policy.server.no_address", "{url} is no websocket address, e.g. ws://127.0.0.1:8000")
_NO_HANDSHAKE = Pattern(
    "policy.server.no_handshake",
    "{url} gave no websocket handshake within {seconds:g} s: what listens there is stuck, or no "
    "websocket server",
)
_NO_TLS = Pattern(
    "policy.server.no_tls",
    "{url}: no encrypted connection ({error}): correct its certificate, name the authority in "
    "SSL_CERT_FILE, or use ws:// where the server has no TLS",
)
_POINTS_ELSEWHERE = Pattern(
    "policy.server.points_elsewhere",
    "{url} points elsewhere ({error}): correct policy.url",
)
_HANDSHAKE_FAILED = Pattern(
    "policy.server.handshake_failed",
    "the connection to {url} failed in the websocket handshake ({error}): see that the policy server "
    "runs, and check host, port and policy.kind: a server of another kind hangs up too",
)
_NO_WEBSOCKET = Pattern(
    "policy.server.no_websocket",
    "what listens at {url} does not speak websocket ({error}): check host, port and policy.kind",
)
_WANTS_KEY = Pattern(
    "policy.server.wants_key",
    "{url} refused the websocket with HTTP {status}: it wants an API key; policy.api_key_env names the "
    "environment variable that holds it",
)
_NO_SERVER_BEHIND = Pattern(
    "policy.server.no_server_behind",
    "{url} has no policy server behind it at the moment (HTTP {status})",
)
_REFUSED = Pattern(
    "policy.server.refused",
    "{url} refused the websocket with HTTP {status}: another web server listens there, or the path or "
    "the API key is wrong; correct policy.url",
)
_REQUEST_NOT_TAKEN = Pattern(
    "policy.server.request_not_taken",
    "{url} did not take the request within {seconds:g} s",
)
_UNSOLICITED = Pattern(
    "policy.server.unsolicited",
    "{url} sent an unrequested message of {bytes} bytes: an answer came twice, by the "
    "server or by what stands before it, and the last one may have been another question's; the "
    "connection is dropped",
)
_SERVER_SAYS = Pattern("policy.server.server_says", "the policy server at {url} reports an error: {error}")
_NOT_IN_TIME = Pattern(
    "policy.server.not_in_time",
    "{url} did not send {what} within {seconds:g} s; the connection is dropped",
)
_TOO_LARGE = Pattern(
    "policy.server.too_large",
    "{url} sent a message that is too large ({why}): it is no policy's answer, or pictures are among "
    "it; the connection is dropped",
)
_CLOSED = Pattern(
    "policy.server.closed",
    "the policy server at {url} closed the connection ({error}): see that it runs",
)

ANSWER_LIMIT = (
    64 * 1024 * 1024
)  # [bytes] per message, metadata included; a chunk of 50 rows has some kilobytes
_TOO_BIG = 1009  # websocket close code "message too big"
CLOSING = "websocket-leave"  # name of the threads that close connections
_CLOSE_TIMEOUT = 0.5  # [s] for the closing handshake; a server busy with inference does not answer it


def wait_closed(seconds: float) -> None:
    """Wait until all closing handshakes are done, at most `seconds` [s]; call it before the process ends."""
    until = time.monotonic() + seconds
    for thread in threading.enumerate():
        if thread.name == CLOSING:
            thread.join(max(0.0, until - time.monotonic()))


class WebsocketLink:
    """Connection that can be opened again until it is aborted.

    Only one thread may use it, except that any thread may call `abort`. `dial` returns the host and port to connect to,
    if they differ from those of the url.
    """

    def __init__(
        self, url: str, headers: Mapping[str, str], connect_deadline: float, dial: Dial | None = None
    ) -> None:
        self._url = url
        self._dial = dial
        self._headers = dict(headers)
        self._connect_deadline = connect_deadline
        self._stack = contextlib.ExitStack()
        self._connection: ClientConnection | None = None
        self._shaking: ClientConnection | None = None  # connection during its handshake
        self._aborted = False
        self._watchdog = Watchdog("websocket-send", self._cut)

    @property
    def is_open(self) -> bool:
        """True if there is a connection; the peer may have left since."""
        return self._connection is not None

    @property
    def closed_by_peer(self) -> bool:
        """True if the peer is known to have closed the connection, as servers do with idle connections."""
        from websockets.protocol import State

        return self._connection is not None and self._connection.state is not State.OPEN

    def open(self) -> bytes:
        """Connect anew and return the server's first frame, both within the connect deadline.

        Raises:
            PolicyLostError: No server listens at the url at present.
            PolicyError: Another kind of server listens there.
        """
        deadline = time.monotonic() + self._connect_deadline
        connection = self._connected(deadline)
        with self._dropping_on_error():
            return self._receive(connection, deadline, _ITS_METADATA, self._connect_deadline)

    def open_silent(self) -> float:
        """Connect anew to a server that only answers; return what is left of the connect deadline [s].

        Raises the same errors as `open`.
        """
        deadline = time.monotonic() + self._connect_deadline
        self._connected(deadline)
        return max(0.0, deadline - time.monotonic())

    def _connected(self, deadline: float) -> ClientConnection:
        self.drop()
        try:
            self._require_not_aborted()
            connection = self._connection = self._connect(deadline)
        except PolicyError:
            self._require_not_aborted()
            raise
        finally:
            self._shaking = None
        with self._dropping_on_error():
            self._require_not_aborted()
        return connection

    def exchange(self, request: bytes, seconds: float) -> bytes:
        """Return the response to `request`.

        Raises PolicyTimeout after `seconds` [s], PolicyDisconnected, or the error that the server sent as text.
        """
        connection = self._connection
        if connection is None:
            raise PolicyError(_NOT_CONNECTED(url=self._url))
        deadline = time.monotonic() + seconds
        with self._dropping_on_error():
            self._require_silence(connection)
            self._send(connection, request, seconds)
            return self._receive(connection, deadline, _AN_ANSWER, seconds)

    def exchange_ack(self, request: bytes, seconds: float, text: str) -> bytes | None:
        """Return the response to `request` as bytes; None if the response is the acknowledgement `text`.

        Some servers send such an acknowledgement as a text frame. Every other text frame is an error message of the
        server, and raises the same errors as in `exchange`.
        """
        connection = self._connection
        if connection is None:
            raise PolicyError(_NOT_CONNECTED(url=self._url))
        deadline = time.monotonic() + seconds
        with self._dropping_on_error():
            self._require_silence(connection)
            self._send(connection, request, seconds)
            answer = self._frame(connection, deadline, _AN_ACKNOWLEDGEMENT, seconds)
            return None if answer == text else self._binary(answer)

    def exchange_matched(
        self, request: bytes, seconds: float, label: str, match: Callable[[bytes], Answer | None]
    ) -> Answer:
        """Return what `match` makes of the response to `request`; messages for which it returns None are skipped.

        `label` names the response in errors, which are those of `exchange`.
        """
        connection = self._connection
        if connection is None:
            raise PolicyError(_NOT_CONNECTED(url=self._url))
        deadline = time.monotonic() + seconds
        with self._dropping_on_error():
            self._send(connection, request, seconds)
            while True:
                answer = match(self._receive(connection, deadline, label, seconds))
                if answer is not None:
                    return answer
                if (
                    time.monotonic() >= deadline
                ):  # else a server that keeps sending others would hold us for ever
                    raise PolicyTimeout(_NOT_IN_TIME(url=self._url, what=label, seconds=seconds))

    def abort(self) -> None:
        """Make calls that wait in another thread raise PolicyError, now and later.

        A call that is resolving a host name raises the error only when the name is resolved, or at the connect
        deadline.
        """
        self._aborted = True
        for connection in (self._shaking, self._connection):
            if connection is not None:
                _end(connection.socket)
        self._watchdog.stop()

    def _require_not_aborted(self) -> None:
        if self._aborted:
            raise PolicyError(_CLOSED_BY_US(url=self._url))

    def close_gracefully(self, farewell: bytes | None = None) -> None:
        """Send `farewell` and a close frame and close the connection, in a separate thread, without waiting for it.

        Without a close frame, servers print a traceback. `farewell` is the protocol's own last message, if it has one.
        If the server does not read, the connection is cut: the thread would otherwise prevent the end of the process.
        """
        from websockets.exceptions import ConnectionClosed

        self._watchdog.stop()
        connection, self._connection = self._connection, None
        resources = self._stack.pop_all()
        if connection is None:
            return

        watchdog = Watchdog("websocket-leave-send", lambda: _end(connection.socket))

        def leave() -> None:
            try:
                with watchdog.deadline(2 * _CLOSE_TIMEOUT), resources, contextlib.suppress(ConnectionClosed):
                    if farewell is not None:
                        connection.send(farewell)
            finally:
                watchdog.stop()

        threading.Thread(target=leave, name=CLOSING).start()

    def drop(self) -> None:
        """Close without waiting for the server. Safe to call twice."""
        self._watchdog.stop()
        connection, self._connection = self._connection, None
        if connection is not None:
            _end(connection.socket)
        self._stack.close()

    def _place(self) -> Place:
        from websockets.exceptions import InvalidURI
        from websockets.uri import parse_uri

        try:
            uri = parse_uri(self._url)
        except InvalidURI as error:
            raise PolicyError(_NO_ADDRESS(url=self._url)) from error
        return self._dial() if self._dial else (uri.host, uri.port)

    def _connect(self, deadline: float) -> ClientConnection:
        from websockets.exceptions import ConnectionClosed, InvalidStatus, InvalidURI, WebSocketException
        from websockets.sync.client import ClientConnection, connect

        link = self

        class Connection(ClientConnection):
            """Connection that is stored before its handshake, so that `abort` can end it during the handshake, too."""

            def __init__(self, *arguments: Any, **options: Any) -> None:
                super().__init__(*arguments, **options)
                link._shaking = self
                if link._aborted:
                    _end(self.socket)

        try:
            seconds = self._connect_deadline
            wire = self._stack.enter_context(
                open_connection(self._url, *self._place(), deadline, seconds, self._require_not_aborted)
            )
            secure = self._url.lower().startswith("wss:")
            return self._stack.enter_context(
                connect(
                    self._url,
                    sock=wire,
                    ssl=allow_two_threads(ssl.create_default_context()) if secure else None,
                    additional_headers=self._headers,
                    compression=None,
                    max_size=ANSWER_LIMIT,
                    # A server that computes on its event loop answers no pings.
                    ping_interval=None,
                    proxy=None,
                    open_timeout=max(1e-3, deadline - time.monotonic()),
                    close_timeout=_CLOSE_TIMEOUT,
                    create_connection=Connection,
                )
            )
        except TimeoutError as error:
            handshake_error = self._shaking and self._shaking.protocol.handshake_exc
            if isinstance(handshake_error, Exception) and not isinstance(
                handshake_error.__cause__, OSError | EOFError
            ):
                raise self._foreign(handshake_error) from error  # it sent something else and stays connected
            raise PolicyTimeout(_NO_HANDSHAKE(url=self._url, seconds=self._connect_deadline)) from error
        except InvalidStatus as error:
            raise self._refused(error.response.status_code) from error
        except ssl.SSLError as error:
            raise TlsError(_NO_TLS(url=self._url, error=error)) from error
        except (InvalidURI, ValueError) as error:  # raised by websockets for a bad redirect
            raise WrongProtocolError(_POINTS_ELSEWHERE(url=self._url, error=error)) from error
        except (WebSocketException, OSError, EOFError) as error:
            gone = isinstance(error, OSError | ConnectionClosed)  # or it closed in the middle of a message
            if gone or isinstance(error.__cause__, OSError | EOFError):
                raise PolicyLostError(_HANDSHAKE_FAILED(url=self._url, error=error)) from error
            raise self._foreign(error) from error

    def _foreign(self, error: Exception) -> PolicyError:
        return WrongProtocolError(_NO_WEBSOCKET(url=self._url, error=error))

    def _refused(self, status: int) -> PolicyError:
        """Return the error for the HTTP status with which a handshake was refused.

        Status 502 to 504 is temporary: a gateway sends it while its server restarts. Others are permanent.
        """
        if status in (401, 403):
            return RefusedError(_WANTS_KEY(url=self._url, status=status))
        if status in (502, 503, 504):
            return PolicyLostError(_NO_SERVER_BEHIND(url=self._url, status=status))
        return WrongProtocolError(_REFUSED(url=self._url, status=status))

    def _send(self, connection: ClientConnection, request: bytes, seconds: float) -> None:
        """Send the request within the deadline: if the server has stopped reading, sending blocks."""
        from websockets.exceptions import ConnectionClosed

        with self._watchdog.deadline(seconds) as was_cut:
            try:
                connection.send(request)
            except ConnectionClosed as error:
                if was_cut():
                    raise PolicyTimeout(_REQUEST_NOT_TAKEN(url=self._url, seconds=seconds)) from error
                raise self._gone(error) from error

    def _require_silence(self, connection: ClientConnection) -> None:
        """Raise an error if a message waits: it would be mistaken for the response to the next request."""
        from websockets.exceptions import ConnectionClosed

        try:
            waiting = connection.recv(timeout=0)
        except TimeoutError:
            return
        except ConnectionClosed as error:
            raise self._gone(error) from error
        raise UnsolicitedError(_UNSOLICITED(url=self._url, bytes=len(self._binary(waiting))))

    def _cut(self) -> None:
        if self._connection is not None:
            _end(self._connection.socket)

    def _receive(self, connection: ClientConnection, deadline: float, label: str, seconds: float) -> bytes:
        return self._binary(self._frame(connection, deadline, label, seconds))

    def _binary(self, answer: str | bytes) -> bytes:
        if isinstance(answer, str):
            raise ServerReportedError(_SERVER_SAYS(url=self._url, error=error_headline(answer)))
        return answer

    def _frame(
        self, connection: ClientConnection, deadline: float, label: str, seconds: float
    ) -> str | bytes:
        from websockets.exceptions import ConnectionClosed

        try:
            return connection.recv(timeout=max(0.0, deadline - time.monotonic()))
        except TimeoutError as error:
            raise PolicyTimeout(_NOT_IN_TIME(url=self._url, what=label, seconds=seconds)) from error
        except ConnectionClosed as error:
            raise self._gone(error) from error

    def _gone(self, error: Exception) -> PolicyError:
        if self._aborted:
            return PolicyError(_CLOSED_BY_US(url=self._url))
        sent = getattr(error, "sent", None)
        if sent is not None and sent.code == _TOO_BIG:
            return WrongProtocolError(_TOO_LARGE(url=self._url, why=sent.reason))
        return PolicyDisconnected(_CLOSED(url=self._url, error=error))

    @contextlib.contextmanager
    def _dropping_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.drop()
            raise


def _end(wire: socket.socket) -> None:
    """Shut the socket down, which wakes every thread that waits on it and makes it unusable."""
    with contextlib.suppress(OSError):
        wire.shutdown(socket.SHUT_RDWR)


def error_headline(text: str) -> str:
    """Return a short text for a server's error: the last line of a traceback, then the whole text; for JSON, its error
    fields.
    """
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError):
        fields = None
    if isinstance(fields, dict):
        texts = [str(fields[key]) for key in ("error", "message", "code") if fields.get(key)]
        text = ", ".join(texts) or text
    lines = text.strip().splitlines() or ["(an empty text)"]
    return lines[-1] if len(lines) == 1 else f"{lines[-1].strip()}\n{text.strip()}"
