"""ZMQ REQ socket with a deadline for every wait. After a lost reply the socket is replaced by a new one."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import zmq

from runtime.core.errors import (
    PolicyDisconnected,
    PolicyError,
    PolicyLostError,
    PolicyTimeout,
    WrongProtocolError,
)
from runtime.policies.connection import Dial, Place, open_connection

_SPELL_MS = 20  # period of the check for an abort [ms]; a response is noticed at once
_SIGNATURE = b"\xff\0\0\0\0\0\0\0\1\x7f"  # first bytes of every ZMTP peer
_KNOCK = _SIGNATURE + b"\r\n\r\n"  # the line ends make a web server respond, too
_FAILED = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
_WATCHED = zmq.EVENT_HANDSHAKE_SUCCEEDED | _FAILED | zmq.EVENT_DISCONNECTED


class ReqLink:
    """REQ socket that can be used by one thread at a time, except that any thread may call `abort`.

    Messages of more than `limit` bytes end the connection. `dial` returns the host and port to connect to, if they
    differ from those of the url.
    """

    def __init__(self, url: str, connect_deadline: float, limit: int, dial: Dial | None = None) -> None:
        self._url = url
        self._dial = dial
        self._connect_deadline = connect_deadline
        self._limit = limit
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._aborted = False

    @property
    def is_open(self) -> bool:
        """True if there is a connection; the peer may have left since."""
        return self._socket is not None

    def open(self) -> float:
        """Connect anew; return the time left until the connect deadline [s].

        Raises:
            PolicyLostError: There is no server, or it sends no greeting in time.
            PolicyError: Another kind of server listens there.
        """
        self.drop()
        deadline = time.monotonic() + self._connect_deadline
        self._require_not_aborted()
        place = self._place()
        self._probe(place, deadline)
        connection: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
        for option, value in (
            (zmq.LINGER, 0),
            (zmq.MAXMSGSIZE, self._limit),
            (
                zmq.REQ_CORRELATE,
                1,
            ),  # REP sockets return the request's number; responses to other requests are dropped
            (
                zmq.RECONNECT_IVL,
                -1,
            ),  # with the connection the request is lost, so the socket must be replaced, too
        ):
            connection.setsockopt(option, value)
        self._socket, self._monitor = connection, connection.get_monitor_socket(_WATCHED)
        with self._dropping_on_error():
            connection.connect(
                f"tcp://[{place[0]}]:{place[1]}" if ":" in place[0] else f"tcp://{place[0]}:{place[1]}"
            )
            self._handshake(deadline)
        return max(0.0, deadline - time.monotonic())

    def exchange(self, request: bytes, seconds: float, what: str = "an answer") -> bytes:
        """Return the response to `request`; `what` names the response in errors.

        Raises:
            PolicyTimeout: No response within `seconds` [s]; the connection is dropped.
            PolicyDisconnected: The server closed the connection.
        """
        wire = self._socket
        if wire is None:
            raise PolicyError(f"there is no connection to {self._url}; connect first")
        deadline = time.monotonic() + seconds
        with self._dropping_on_error():
            try:
                wire.send(request, zmq.NOBLOCK)
            except zmq.Again as error:  # the peer has left
                raise PolicyDisconnected(
                    f"the policy server at {self._url} closed the connection since the last request: see that it runs"
                ) from error
            while (frames := _receive_reply(wire)) is None:
                self._require_not_aborted()
                if time.monotonic() >= deadline:
                    raise PolicyTimeout(
                        f"{self._url} did not send {what} within {seconds:g} s; the connection is dropped"
                    )
                if self._poll_events() & zmq.EVENT_DISCONNECTED and not wire.poll(0):
                    raise PolicyDisconnected(
                        f"the policy server at {self._url} closed the connection before {what}: see that it runs, and "
                        f"that it sends no more than {self._limit} bytes"
                    )
            if len(frames) != 1:
                raise WrongProtocolError(
                    f"{self._url} sent a message of {len(frames)} frames; expected one: it is no GR00T server"
                )
            return frames[0]

    def abort(self) -> None:
        """Make calls that wait in another thread raise PolicyError, now and later."""
        self._aborted = True

    def drop(self) -> None:
        """Close the connection and drop unsent messages. Safe to call twice."""
        wire, self._socket = self._socket, None
        monitor, self._monitor = self._monitor, None
        if wire is not None:
            wire.disable_monitor()
            wire.close(linger=0)
        if monitor is not None:
            monitor.close(linger=0)

    def _require_not_aborted(self) -> None:
        if self._aborted:
            raise PolicyError(f"the connection to {self._url} was closed from our side")

    def _place(self) -> Place:
        parts = urlsplit(self._url)
        return self._dial() if self._dial else (parts.hostname or "", parts.port or 0)

    def _probe(self, place: Place, deadline: float) -> None:
        """Check that a ZMQ server listens before ZMQ connects, which would retry without end and without an error."""
        try:
            seconds = self._connect_deadline
            with open_connection(self._url, *place, deadline, seconds, self._require_not_aborted) as wire:
                wire.settimeout(_SPELL_MS / 1e3)
                wire.sendall(_KNOCK)
                self._require_zmq(self._greeting(wire, deadline))
        except TimeoutError as error:
            raise PolicyTimeout(
                f"{self._url} gave no ZMQ greeting within {self._connect_deadline:g} s: what listens there is stuck, "
                "or speaks another protocol"
            ) from error
        except OSError as error:
            raise PolicyLostError(f"the connection to {self._url} failed ({error})") from error

    def _greeting(self, wire: socket.socket, deadline: float) -> bytes:
        greeting = b""
        while len(greeting) < len(_SIGNATURE):
            self._require_not_aborted()
            if time.monotonic() >= deadline:
                raise TimeoutError("no greeting")
            with contextlib.suppress(TimeoutError):
                more = wire.recv(64)
                if not more:
                    break
                greeting += more
        return greeting

    def _require_zmq(self, greeting: bytes) -> None:
        if not greeting:
            raise PolicyLostError(
                f"{self._url} closed the connection at once: see that the policy server runs, and check "
                "host, port and policy.kind: a server of another kind hangs up too"
            )
        if greeting[0] != 0xFF or len(greeting) < len(_SIGNATURE) or greeting[9] != 0x7F:
            raise WrongProtocolError(
                f"the server at {self._url} does not speak ZMQ (it answers {greeting[:40]!r}): "
                "check host, port and policy.kind"
            )

    def _handshake(self, deadline: float) -> None:
        while True:
            self._require_not_aborted()
            events = self._poll_events(_SPELL_MS)
            if events & zmq.EVENT_HANDSHAKE_SUCCEEDED:
                return
            if events:  # failed, or the peer closed in the middle, as it does if socket types do not match
                raise WrongProtocolError(
                    f"{self._url} speaks ZMQ but takes no requests (its socket is no REP socket, or it wants keys): "
                    "the port of an execution node, perhaps; correct policy.url"
                )
            if time.monotonic() >= deadline:
                raise PolicyTimeout(
                    f"{self._url} gave no ZMQ handshake within {self._connect_deadline:g} s: what listens there is "
                    "stuck"
                )

    def _poll_events(self, milliseconds: int = 0) -> int:
        """Return the events of the connection since the last call, as one bit set of ZMQ's events."""
        from zmq.utils.monitor import recv_monitor_message  # imported here: it also imports asyncio

        monitor, events = self._monitor, 0
        assert monitor is not None
        while monitor.poll(0 if events else milliseconds):
            events |= int(recv_monitor_message(monitor, zmq.NOBLOCK)["event"])
        return events

    @contextlib.contextmanager
    def _dropping_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.drop()
            raise


def _receive_reply(wire: zmq.Socket[bytes]) -> list[bytes] | None:
    """Return the frames of the response, None if it does not arrive within a polling period.

    ZMQ itself drops responses to earlier requests.
    """
    try:
        return wire.recv_multipart(zmq.NOBLOCK) if wire.poll(_SPELL_MS) else None
    except zmq.Again:
        return None
