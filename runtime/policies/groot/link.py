"""A ZMQ REQ socket whose every wait has a deadline, and that is built anew after a lost reply."""

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

_SPELL_MS = 20  # how soon a wait notices that it was aborted; an answer is noticed at once
_SIGNATURE = b"\xff\0\0\0\0\0\0\0\1\x7f"  # how every ZMTP peer begins
_KNOCK = _SIGNATURE + b"\r\n\r\n"  # the line ends make a web server answer too
_FAILED = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
_WATCHED = zmq.EVENT_HANDSHAKE_SUCCEEDED | _FAILED | zmq.EVENT_DISCONNECTED


class ReqLink:
    """For one thread at a time, except for `abort`; messages of more than `limit` bytes end the connection.

    `dial` says where the url's host and port are connected to, where that is elsewhere.
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
        """True if a connection is held; the peer may have gone since."""
        return self._socket is not None

    def open(self) -> float:
        """Connect anew; what is left of the connect deadline [s].

        PolicyLostError where nobody is there, or nobody who greets in time; PolicyError where somebody else is.
        """
        self.drop()
        deadline = time.monotonic() + self._connect_deadline
        self._require_not_aborted()
        place = self._place()
        self._probe(place, deadline)
        made: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
        for option, value in (
            (zmq.LINGER, 0),
            (zmq.MAXMSGSIZE, self._limit),
            (zmq.REQ_CORRELATE, 1),  # a REP socket gives the request's number back; another's is thrown away
            (zmq.RECONNECT_IVL, -1),  # after a lost connection the request is lost, and so is the socket
        ):
            made.setsockopt(option, value)
        self._socket, self._monitor = made, made.get_monitor_socket(_WATCHED)
        with self._dropping_on_error():
            made.connect(
                f"tcp://[{place[0]}]:{place[1]}" if ":" in place[0] else f"tcp://{place[0]}:{place[1]}"
            )
            self._handshake(deadline)
        return max(0.0, deadline - time.monotonic())

    def exchange(self, request: bytes, seconds: float, what: str = "an answer") -> bytes:
        """The answer to `request`; PolicyTimeout after `seconds`, PolicyGone; both end the connection."""
        wire = self._socket
        if wire is None:
            raise PolicyError(f"there is no connection to {self._url}; connect first")
        deadline = time.monotonic() + seconds
        with self._dropping_on_error():
            try:
                wire.send(request, zmq.NOBLOCK)
            except zmq.Again as error:  # there is nobody any more to send it to
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
        """From another thread: whoever waits here raises PolicyError, now and later."""
        self._aborted = True

    def drop(self) -> None:
        """End the connection and whatever is left to send; safe to call twice."""
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
        """See who listens, before ZMQ, which would try again for ever and say nothing."""
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
        said = b""
        while len(said) < len(_SIGNATURE):
            self._require_not_aborted()
            if time.monotonic() >= deadline:
                raise TimeoutError("no greeting")
            with contextlib.suppress(TimeoutError):
                more = wire.recv(64)
                if not more:
                    break
                said += more
        return said

    def _require_zmq(self, said: bytes) -> None:
        if not said:
            raise PolicyLostError(
                f"{self._url} closed the connection at once: see that the policy server runs, and check "
                "host, port and policy.kind: a server of another kind hangs up too"
            )
        if said[0] != 0xFF or len(said) < len(_SIGNATURE) or said[9] != 0x7F:
            raise WrongProtocolError(
                f"what listens at {self._url} does not speak ZMQ (it says {said[:40]!r}): "
                "check host, port and policy.kind"
            )

    def _handshake(self, deadline: float) -> None:
        while True:
            self._require_not_aborted()
            heard = self._poll_events(_SPELL_MS)
            if heard & zmq.EVENT_HANDSHAKE_SUCCEEDED:
                return
            if heard:  # it failed, or the peer hung up in the middle, as it does where sockets do not match
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
        """Events of the connection since the last call, as one set of ZMQ's events."""
        from zmq.utils.monitor import recv_monitor_message  # it brings asyncio along

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
    """The frames of an answer, None where none comes within a spell: what answers another request is thrown away."""
    try:
        return wire.recv_multipart(zmq.NOBLOCK) if wire.poll(_SPELL_MS) else None
    except zmq.Again:
        return None
