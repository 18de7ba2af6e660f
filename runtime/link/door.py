"""Listening port of a lab: its connections, their messages, and the cutting off of connections.

Everything that a connection can use up is bounded here: messages per turn, bytes per second, the time until it
identifies itself, and the number of connections. A connection that exceeds a bound is cut off and its key refused for a
while; other connections are not affected.
"""

from __future__ import annotations

import ctypes
import logging
import os
import socket as sockets
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from runtime.core.errors import CodecError, TransportError
from runtime.link.admission import AllowList, Seldom
from runtime.link.key_files import KeyPair, z85
from runtime.link.wire import MOST_PARTS, Beat, Bye, Message, read, write

log = logging.getLogger(__name__)
_EVENTS = zmq.EVENT_ACCEPTED | zmq.EVENT_CLOSED | zmq.EVENT_DISCONNECTED
_TURN = 200  # messages handled per turn
_TURN_BYTES = 16 << 20
_TURN_PARTS = 20_000  # about 20 ms for messages of many empty parts
_QUEUED = 64  # messages per connection and direction
_HANDSHAKE_MS = 2000
_NAMED_S = 5.0  # from connecting to the first message [s]
_SILENT_S = 5.0  # silence of an identified connection [s]
_LAST_WORD_S = 0.3  # for a Bye to be sent before the connection is closed [s]
_LOOK_S, _WATCH_S = 1.0, 0.05
_UNNAMED_BYTES = 16 << 10  # handshake and first message together
_MOST_MESSAGES = 2000  # per connection and second; usual are at most some hundred
_MOST_CONNECTIONS = 1024
_BACKLOG = 256
_BYTES_RECEIVED = 128  # offset of tcpi_bytes_received in struct tcp_info
_TCP_INFO_BYTES = 192
Address = tuple[Any, ...]


@dataclass(slots=True)
class Peer:
    """Remote end of a connection: descriptor in this process, remote address, and counters."""

    descriptor: int
    address: Address
    since: float
    route: bytes = b""
    key: str = ""
    heard_at: float = 0.0
    received: int = 0
    read: int = 0  # bytes received when its last complete message was noticed
    messages: int = 0  # since the last call of `look`
    cut_at: float = float("inf")

    def __str__(self) -> str:
        return f"{str(self.address[0]).removeprefix('::ffff:')}:{self.address[1]}"


@dataclass(frozen=True, slots=True)
class Arrival:
    """Received message with its connection and the key of that connection."""

    route: bytes
    key: str
    message: Message
    parts: list[bytes]


@dataclass(slots=True)
class _PeerIndex:
    by_descriptor: dict[int, Peer] = field(default_factory=dict)
    by_route: dict[bytes, Peer] = field(default_factory=dict)


class Door:
    """Listening port. One thread uses it and calls `arrivals` and `poll` regularly.

    `rate`: Bytes per second that one connection may send, measured over about one second.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        host: str,
        port: int,
        key: KeyPair,
        largest: int,
        rate: float,
        allowed: AllowList,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock, self._rate, self._allowed = clock, rate, allowed
        self._known = _PeerIndex()
        self._seldom = Seldom(clock)
        self._looked = self._watched = clock()
        self._parts: list[zmq.Frame] = []  # parts of an incomplete message
        self.gone: list[bytes] = []  # connections that have ended; the caller clears it
        self.socket = context.socket(zmq.ROUTER)
        self.socket.linger = 0
        self.socket.set(zmq.ROUTER_MANDATORY, 1)
        self.socket.set(zmq.RCVHWM, _QUEUED)
        self.socket.set(zmq.SNDHWM, _QUEUED)
        self.socket.set(zmq.MAXMSGSIZE, largest)
        self.socket.set(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        # No heartbeats of ZMQ: libzmq 4.3.5 aborts if one is due on a connection that broke while it was not read,
        # which a flood causes. Our own messages are the signs of life; `look` ends silent connections.
        self.socket.set(zmq.BACKLOG, _BACKLOG)
        self.socket.set(zmq.IPV6, 1)
        self.socket.zap_domain = b"stations"
        self.socket.curve_server = True
        self.socket.curve_secretkey, self.socket.curve_publickey = z85(key.secret), z85(key.public)
        self._monitor = self.socket.get_monitor_socket(_EVENTS)
        self.port = self._bind(host, port)

    def _bind(self, host: str, port: int) -> int:
        displayed_host = f"[{host}]" if ":" in host else host
        try:
            self.socket.bind(f"tcp://{displayed_host}:{port or '*'}")
        except zmq.ZMQError as error:
            self.close()
            raise TransportError(
                f"cannot listen for stations at {displayed_host}:{port}: {error.strerror}"
            ) from None
        bound = self.socket.last_endpoint.decode()
        return int(bound.rpartition(":")[2])

    def arrivals(self) -> list[Arrival]:
        """Return received messages, bounded per turn. A connection that sends an unreadable message is cut off."""
        self._hear_of_connections()
        arrivals: list[Arrival] = []
        room, self._room = _TURN_BYTES, _TURN_PARTS
        for _ in range(_TURN):
            if room <= 0 or not (frames := self._message()):
                break
            room -= sum(len(frame) for frame in frames)
            if (arrival := self._arrival(frames)) is not None:
                arrivals.append(arrival)
        return arrivals

    def _message(self) -> list[zmq.Frame]:
        """Return the frames of the next complete message, [] if there is none.

        Surplus parts of a message are dropped; enough are kept that the message is recognised as too long.
        """
        with suppress(zmq.Again):
            while self._room:
                self._room -= 1
                frame = self.socket.recv(zmq.NOBLOCK, copy=False)
                if len(self._parts) <= MOST_PARTS + 2:
                    self._parts.append(frame)
                if not frame.more:
                    frames, self._parts = self._parts, []
                    return frames
        return []

    def send(self, route: bytes, message: Message, *parts: bytes) -> bool:
        """Send a message without waiting; return False if the connection has ended or its queue is full."""
        try:
            self.socket.send_multipart([route, *write(message, *parts)], zmq.NOBLOCK)
        except zmq.ZMQError:  # EHOSTUNREACH, EAGAIN
            return False
        return True

    def key_of(self, route: bytes) -> str:
        """Return the key of a connection, hexadecimal; "" if it has ended."""
        peer = self._known.by_route.get(route)
        return peer.key if peer is not None else ""

    def address_of(self, route: bytes) -> str:
        """Return the remote address of a connection, without port; "" if it has ended."""
        peer = self._known.by_route.get(route)
        return str(peer.address[0]) if peer is not None else ""

    def cut(self, route: bytes, why: str, again_s: float = 30.0) -> None:
        """Send the reason `why` and close the connection a moment later; its further messages are ignored.

        The station may connect again after `again_s` [s].
        """
        peer = self._known.by_route.pop(route, None)
        if peer is None:
            return
        self.send(route, Bye(why, again_s))
        peer.cut_at = min(peer.cut_at, self._clock() + _LAST_WORD_S)
        self.gone.append(route)
        if self._seldom.due(peer.key or str(peer)):
            log.warning("%s is cut off: %s", peer, why)

    def poll(self) -> None:
        """Cut off connections that flood, are silent, or are too many. Call regularly."""
        now = self._clock()
        for peer in [
            candidate for candidate in self._known.by_descriptor.values() if now >= candidate.cut_at
        ]:
            self._shut(peer)
        if now - self._watched >= _WATCH_S:
            self._watch()
            self._watched = now
        if now - self._looked < _LOOK_S:
            return
        seconds, self._looked = now - self._looked, now
        for peer in list(self._known.by_descriptor.values()):
            received = _received(peer)
            more, peer.received = received - peer.received, received
            messages, peer.messages = peer.messages, 0
            if more > self._rate * seconds:
                self._flood(
                    peer, f"it sends {more / seconds / 1e6:.0f} MB a second; allowed: {self._rate / 1e6:.0f}"
                )
            elif messages > _MOST_MESSAGES * seconds:
                self._flood(
                    peer, f"it sends {messages / seconds:.0f} messages a second; allowed: {_MOST_MESSAGES}"
                )
            elif now - (peer.heard_at or peer.since) > (_SILENT_S if peer.route else _NAMED_S):
                self._end(peer, "it says nothing")

    def _watch(self) -> None:
        """Cut off connections that send a message without an end, and surplus unidentified connections.

        It runs every `_WATCH_S`, because thousands of connections can arrive within a moment.
        """
        unnamed = [peer for peer in self._known.by_descriptor.values() if not peer.route]
        for peer in unnamed[: max(0, len(self._known.by_descriptor) - _MOST_CONNECTIONS)]:
            self._end(peer, f"there are more than {_MOST_CONNECTIONS} connections")
        for peer in list(self._known.by_descriptor.values()):
            received = _received(peer)
            if peer.heard_at >= self._watched:
                peer.read = received
            elif received - peer.read > (self._rate if peer.route else _UNNAMED_BYTES):
                self._flood(peer, f"it has sent {received - peer.read} bytes without a whole message")

    def close(self) -> None:
        """Release the port."""
        self.socket.disable_monitor()
        self._monitor.close(linger=0)
        self.socket.close(linger=0)

    # --- who there is ------------------------------------------------------------------------------------------

    def _hear_of_connections(self) -> None:
        with suppress(zmq.Again):
            while True:
                event = recv_monitor_message(self._monitor, zmq.NOBLOCK)
                self._forget(int(event["value"]))
                if event["event"] == zmq.EVENT_ACCEPTED:
                    self._remember(int(event["value"]))

    def _remember(self, descriptor: int) -> None:
        address = _address(descriptor)
        if address is not None:
            now = self._clock()
            self._known.by_descriptor[descriptor] = Peer(descriptor, address, now)

    def _forget(self, descriptor: int) -> None:
        peer = self._known.by_descriptor.pop(descriptor, None)
        if peer is not None and self._known.by_route.pop(peer.route, None) is not None:
            self.gone.append(peer.route)

    def _arrival(self, frames: list[zmq.Frame]) -> Arrival | None:
        route = frames[0].bytes
        peer = self._known.by_route.get(route) or self._named(route, frames[-1])
        if peer is None:
            return None
        peer.heard_at = self._clock()
        peer.messages += 1
        try:
            message, parts = read([frame.bytes for frame in frames[1:]])
        except CodecError as error:
            self._flood(peer, f"unreadable message: {error}")
            return None
        return Arrival(route, peer.key, message, parts)

    def _named(self, route: bytes, frame: zmq.Frame) -> Peer | None:
        """Return the peer at the other end of connection `route`, whose first message is in `frame`.

        The result is None if the connection has ended or was cut off.
        """
        try:
            descriptor, key = int(frame.get(zmq.SRCFD)), str(frame["User-Id"])
        except (zmq.ZMQError, KeyError, TypeError, ValueError):
            return None
        peer = self._known.by_descriptor.get(descriptor)
        if (
            peer is None or peer.route
        ):  # connected during this turn, perhaps with the descriptor of an ended connection
            self._hear_of_connections()
            peer = self._known.by_descriptor.get(descriptor)
        if peer is None or peer.route == route or (peer.route and self._is_there(peer.route)):
            return None  # a message sent before the connection was cut off or ended
        if self._known.by_route.pop(peer.route, None) is not None:
            self.gone.append(peer.route)
        peer.route, peer.key = route, key
        self._known.by_route[route] = peer
        return peer

    def _is_there(self, route: bytes) -> bool:
        """Return True if the connection still exists.

        A message may be read only after its connection has ended and its descriptor was given to another connection.
        """
        self.socket.get(zmq.EVENTS)  # makes ZMQ process ended connections
        return self.send(route, Beat())

    def _flood(self, peer: Peer, reason: str) -> None:
        """Cut the connection off, and refuse its key for a while; if the key is not a station's, refuse the address."""
        if peer.route in self._known.by_route:
            is_known = peer.key in self._allowed.now.stations
            self._allowed.refuse(peer.key if is_known else str(peer.address[0]), self._clock())
        self._end(peer, reason)

    def _end(self, peer: Peer, reason: str) -> None:
        if peer.route in self._known.by_route:
            self.cut(peer.route, reason)
        elif peer.cut_at == float("inf"):
            self._shut(peer)
            if self._seldom.due(str(peer.address[0])):
                log.warning("%s is cut off: %s", peer, reason)

    def _shut(self, peer: Peer) -> None:
        """Break the peer's TCP connection, so that ZMQ notices.

        A newer connection with the same descriptor is never broken.
        """
        self._known.by_descriptor.pop(peer.descriptor, None)
        with suppress(OSError), _same(peer.descriptor) as connection:
            if connection.getpeername() == peer.address:
                _break(connection)


def _address(descriptor: int) -> Address | None:
    """Return the remote address of a connection; None if it has ended."""
    try:
        with _same(descriptor) as connection:
            address = connection.getpeername()
    except OSError:
        return None
    return address if isinstance(address, tuple) and len(address) > 1 else None


def _received(peer: Peer) -> int:
    """Return the bytes received over a connection so far; the last known number if it has ended."""
    try:
        with _same(peer.descriptor) as connection:
            if connection.getpeername() != peer.address:
                return peer.received
            tcp_info = connection.getsockopt(sockets.IPPROTO_TCP, sockets.TCP_INFO, _TCP_INFO_BYTES)
    except OSError:
        return peer.received
    if len(tcp_info) < _BYTES_RECEIVED + 8:
        return peer.received
    count: int = struct.unpack_from("=Q", tcp_info, _BYTES_RECEIVED)[0]
    return count


def _break(connection: sockets.socket) -> None:
    """Reset the connection at once.

    A mere shutdown would leave the queued and still arriving bytes of a flood to be read. Python offers no reset; it is
    a connect to no address (connect(2), AF_UNSPEC). If that fails, the connection is shut down.
    """
    nowhere = struct.pack("=H14x", sockets.AF_UNSPEC)
    if ctypes.CDLL(None).connect(connection.fileno(), nowhere, len(nowhere)) != 0:
        connection.shutdown(sockets.SHUT_RDWR)


def _same(descriptor: int) -> sockets.socket:
    """Return a new socket object for the connection with this descriptor, over a duplicate of the descriptor.

    Raises: OSError if the descriptor is not a socket.
    """
    copy = os.dup(descriptor)
    try:
        return sockets.socket(fileno=copy)
    except OSError:
        os.close(copy)
        raise
