"""Sockets of a station: commands, snapshots, pictures and numbered events; independent of robots.

The sockets are Unix sockets in a folder that only this account can enter. Clients find their paths in the station's
folder, to which each station process writes its endpoints.
"""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import zmq

from runtime.core.errors import CodecError, ConfigurationError, TransportError
from runtime.core.msgpack_arrays import pack, unpack
from runtime.core.sentences import Pattern
from runtime.ipc.endpoints import LOOK_S, Endpoints, account_name, file_identity, new_socket_path
from runtime.ipc.identity import Key
from runtime.ipc.messages import Ack, Command, Event, decode, encode, sentence_fields
from runtime.ipc.readable import readable

_TOO_MANY = Pattern(
    "bus.too_many",
    "more than {most} requests at once over one connection: wait for answers; stops are obeyed",
)
_NO_COMMAND = Pattern("bus.no_command", "expected a Command, got {kind}")
_NO_ANSWER = Pattern("bus.no_answer", "no answer to {kind} within {seconds:g} s: outcome unknown")
_TOO_LARGE = Pattern("bus.too_large", "{kind} has {given} bytes; allowed: {most}")

# What clients import to communicate with a station, with the errors that they may catch.
__all__ = [
    "CodecError",
    "CommandClient",
    "CommandServer",
    "Endpoints",
    "EventLog",
    "IncomingMessage",
    "Key",
    "Publisher",
    "Subscriber",
    "TransportError",
]

log = logging.getLogger(__name__)
# Queue length of a publisher per slow reader, beyond which ZMQ drops the newest message. ZMQ counts a queue as
# emptied only when half of it is, so it must hold two bursts: all events, all cameras at once.
STREAM_HIGH_WATER = 64
CAMERA_HIGH_WATER = 16
# A reader that polls rarely must find all messages in its own queue, or the newest stays hidden behind old
# ones.
_READER_HIGH_WATER = 256
_AWAY_S = 1.0
EVENTS_KEPT = 2000


# Listening sockets: a peer without a handshake is dropped after a second, a dead connection after 20 s.
_HANDSHAKE_MS, _HEARTBEAT_MS, _SILENT_MS = 1000, 5000, 20_000
_BACKLOG = 1024
_LOOK_S = LOOK_S
LARGEST = 256 << 10  # [bytes] of a command
_QUEUED = 256  # commands of one connection that are queued before it has to wait
_UNREAD = 2000  # answers that a connection has not read; more than those of one turn
MAX_WAITING_PER_CONNECTION = 32  # requests of one connection that may wait; more are refused
MAX_MESSAGES_PER_TURN = 1000  # messages read from a socket in one turn
TOO_MANY = _TOO_MANY(most=MAX_WAITING_PER_CONNECTION)


class Listener:
    """Listening socket in the station's folder of sockets; `endpoint` is its address.

    Raises:
        TransportError: it cannot listen.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        kind: int,
        station_dir: Path,
        name: str,
        incoming: int,
        outgoing: int,
    ) -> None:
        self._station_dir, self._name = station_dir, name
        self._looked = time.monotonic()
        path = new_socket_path(station_dir, name)
        self.socket = context.socket(kind)
        self.socket.set(zmq.RCVHWM, incoming)
        self.socket.set(zmq.SNDHWM, outgoing)
        self.socket.set(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        self.socket.set(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        self.socket.set(zmq.HEARTBEAT_TIMEOUT, _SILENT_MS)
        self.socket.set(zmq.BACKLOG, _BACKLOG)
        self.socket.set(zmq.MAXMSGSIZE, LARGEST)
        self.socket.linger = 0
        self._told = ""
        self._bind(path)

    def _bind(self, path: Path) -> None:
        try:
            self.socket.bind(f"ipc://{path}")
        except zmq.ZMQError as error:
            raise TransportError(f"cannot listen at {path}: {error.strerror}") from None
        self._path, self.endpoint = path, f"ipc://{path}"
        self._identity = file_identity(path)

    def rebind_if_unreachable(self) -> bool:
        """Listen at a new path if clients cannot connect, or other accounts could; return True if the path has changed.

        The session folder ($XDG_RUNTIME_DIR) is removed at the account's last logout, and its mode or owner may change.
        Existing connections continue. The socket is checked at most every `LOOK_S` seconds.
        """
        if time.monotonic() - self._looked < _LOOK_S:
            return False
        self._looked = time.monotonic()
        if file_identity(self._path) == self._identity != (0, 0):
            return False
        try:
            self._bind(new_socket_path(self._station_dir, self._name))
        except (TransportError, OSError) as error:
            if self._told != str(error):
                self._told = str(error)
                log.error("%s at %s accepts no connections: %s", self._name, self._path, error)
            return False
        log.warning(
            "clients cannot connect to %s any more, or others can: it is %s now", self._name, self._path
        )
        return True

    def close(self) -> None:
        """Close the socket and remove its file."""
        self.socket.close()
        self._path.unlink(missing_ok=True)  # ZMQ does not remove it


@dataclass(frozen=True, slots=True)
class IncomingMessage:
    """Received message: connection, content, signature (empty: unsigned), sender's account and process.

    `uid` and `pid` are None if the kernel does not report them.
    """

    address: list[bytes]
    payload: bytes
    signature: bytes
    uid: int | None
    pid: int | None


def _call(frames: list[zmq.Frame]) -> IncomingMessage:
    """Split the frames of a ROUTER: connection, empty frame (if any), content, signature.

    Surplus frames are joined to the signature, which makes it invalid.
    """
    body = 2 if len(frames) > 2 and not len(frames[1]) else 1
    address = [frame.bytes for frame in frames[:body]]
    payload = frames[body].bytes if len(frames) > body else b""
    signature = b"".join(frame.bytes for frame in frames[body + 1 :])
    return IncomingMessage(address, payload, signature, *_peer(frames[-1]))


def _peer(frame: zmq.Frame) -> tuple[int | None, int | None]:
    """Return account and process of the message's sender, from the kernel's report to ZMQ "localhost:UID:GID:PID".

    Both are None if there is no such report.
    """
    try:
        _, uid, _, pid = str(frame["Peer-Address"]).split(":")
        return int(uid), int(pid)
    except (zmq.ZMQError, KeyError, ValueError):
        return None, None


@lru_cache(maxsize=8)  # cache: a flood is refused for one reason
def _refusal(reason: str) -> bytes:
    return encode(Ack("", "refused", reason))


class CommandServer(Listener):
    """Server side of commands, a ROUTER socket that never blocks its owner."""

    def __init__(self, context: zmq.Context[Any], station_dir: Path, name: str) -> None:
        super().__init__(context, zmq.ROUTER, station_dir, name, _QUEUED, _UNREAD)

    def receive(self) -> tuple[IncomingMessage, Command] | None:
        """Return the next command with its message, None if there is none.

        An unreadable message is answered with a refusal that contains the reason; no exception is raised.
        """
        while (call := self.receive_raw()) is not None:
            if (command := self.decode(call)) is not None:
                return call, command
        return None

    def receive_raw(self) -> IncomingMessage | None:
        """Return the next message without decoding it, None if there is none."""
        if not readable(self.socket):
            return None
        try:
            return _call(self.socket.recv_multipart(zmq.NOBLOCK, copy=False))
        except zmq.Again:
            return None

    def decode(self, call: IncomingMessage) -> Command | None:
        """Return the command in a message; if the message contains none, send a refusal and return None."""
        try:
            message = decode(call.payload)
        except CodecError as error:
            self.reject(call, str(error))
            return None
        if isinstance(message, Command):
            return message
        self.reject(call, _NO_COMMAND(kind=type(message).__name__))
        return None

    def reject(self, call: IncomingMessage, reason: str) -> None:
        """Refuse a message that was not decoded; so the refusal has no uuid."""
        self._send(call, _refusal(reason))

    def answer(self, call: IncomingMessage, ack: Ack) -> None:
        """Send an answer; it is lost if the client is gone or does not read."""
        self._send(call, encode(ack))

    def pass_on(self, call: IncomingMessage, payload: bytes) -> None:
        """Send an answer that a station on another computer has already encoded."""
        self._send(call, payload)

    def _send(self, call: IncomingMessage, payload: bytes) -> None:
        self.socket.send_multipart([*call.address, payload], zmq.NOBLOCK)


class CommandClient:
    """Client side of commands: one command at a time, each with a deadline.

    After a timeout the connection is dropped with all messages in both directions: a late answer is never matched to
    another command, and an unsent command is not delivered hours later.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        key: Key | None = None,
        owner: int | None = None,
    ) -> None:
        """Connect to `endpoint`.

        Commands are signed with `key`, if there is one. `owner` is the station's account: only answers of that account,
        of this process's account and of root are trusted.
        """
        self._context = context
        self._believed = {os.geteuid(), 0, owner}
        self.strangers = ""  # describes the sender of answers that were ignored
        self._endpoint = endpoint
        self._key = key
        self._connect()

    def _connect(self) -> None:
        self._socket: zmq.Socket[Any] = self._context.socket(zmq.DEALER)
        self._socket.linger = 200
        self._socket.connect(self._endpoint)

    def send(self, command: Command) -> None:
        """Send a command without waiting for its answer. It is signed if there is a key.

        With an unusable key the command is sent unsigned, and an error is logged.

        Raises:
            CodecError: the command exceeds LARGEST bytes.
        """
        self._socket.send_multipart(self._signed(command))

    def request(self, command: Command, timeout: float) -> Ack:
        """Send a command and return its answer.

        Raises:
            TransportError: no answer within `timeout` [s], "outcome unknown".
            CodecError: as in `send`.
        """
        self.send(command)
        answer = self.receive_answer(command, timeout)
        if answer is not None:
            return answer
        self._socket.close(linger=0)
        self._connect()
        raise TransportError(_NO_ANSWER(kind=command.kind, seconds=timeout))

    def receive_answer(self, command: Command, timeout: float) -> Ack | None:
        """Return the answer to `command`, or None after `timeout` [s].

        Answers of untrusted accounts are skipped and described in `strangers`.
        """
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            if not self._socket.poll(int(left * 1000) + 1):
                continue
            if (packed := self.packed_answer()) is None:
                continue
            answer = decode(packed)
            if isinstance(answer, Ack) and answer.uuid in (command.uuid, ""):
                return answer
        return None

    @property
    def socket(self) -> zmq.Socket[Any]:
        """The socket, for a poller: readable when an answer has arrived."""
        return self._socket

    def forward(self, payload: bytes, signature: bytes) -> None:
        """Send a command that another process has already encoded, with its signature."""
        self._socket.send_multipart([payload, signature], zmq.NOBLOCK)

    def packed_answer(self) -> bytes | None:
        """Return the next answer without decoding it; None if there is none or the sender is not trusted."""
        try:
            frame = self._socket.recv(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        uid, pid = _peer(frame)
        if uid is not None and uid not in self._believed:
            self.strangers = (
                f"the process {pid} of {account_name(uid)} answers at {self._endpoint}: not believed"
            )
            return None
        packed: bytes = frame.bytes
        return packed

    def _signed(self, command: Command) -> list[bytes]:
        payload = encode(command)
        if len(payload) > LARGEST:
            raise CodecError(_TOO_LARGE(kind=command.kind, given=len(payload), most=LARGEST))
        if self._key is None:
            return [payload]
        try:
            return [payload, self._key.sign(payload)]
        except ConfigurationError as error:
            log.error("%s goes without a signature: %s", command.kind, error)
            return [payload]

    def close(self) -> None:
        self._socket.close()


class Publisher(Listener):
    """Publisher of streams in which only the newest message matters; a slow reader misses messages.

    `topics` are the subscribed prefixes of stream names.
    """

    def __init__(self, context: zmq.Context[Any], station_dir: Path, name: str, high_water: int) -> None:
        super().__init__(context, zmq.XPUB, station_dir, name, high_water, high_water)
        self.topics: set[str] = set()  # prefixes of streams that have a subscriber

    def poll_subscriptions(self) -> list[str]:
        """Process new subscriptions and cancellations; return the topics that were subscribed since the last call."""
        begun = []
        with suppress(zmq.Again):
            while readable(self.socket):
                message = self.socket.recv(zmq.NOBLOCK)
                topic = message[1:].decode("utf-8", "replace")
                if message[:1] == b"\x01":
                    self.topics.add(topic)
                    begun.append(topic)
                elif message[:1] == b"\x00":
                    self.topics.discard(topic)
        return begun

    def has_subscriber(self, stream: str) -> bool:
        """Return True if `stream` has a subscriber, as of the last `poll_subscriptions`."""
        return any(stream.startswith(topic) for topic in self.topics)

    def publish(self, stream: str, payload: object) -> None:
        """Send `payload` under the name `stream`; never blocks."""
        content = payload if isinstance(payload, bytes) else pack(payload)
        self.socket.send_multipart([stream.encode(), content], zmq.NOBLOCK)


class Subscriber:
    """Receiver of streams whose names begin with given prefixes; it returns the newest message of each."""

    def __init__(self, context: zmq.Context[Any], endpoint: str, *streams: str) -> None:
        self._context = context
        self._endpoint = endpoint
        self._streams = streams
        self._connect()

    def _connect(self) -> None:
        self._read_at = time.monotonic()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set_hwm(_READER_HIGH_WATER)
        for stream in self._streams:
            self._socket.subscribe(stream.encode())
        self._socket.connect(self._endpoint)

    def receive(self, timeout: float) -> dict[str, Any]:
        """Return the newest content of every stream that has a message within `timeout` seconds.

        If the last call was more than a second ago, it reconnects, which takes some milliseconds: the messages queued
        meanwhile, here and in the kernel, are old.
        """
        if time.monotonic() - self._read_at > _AWAY_S:
            self._socket.close(linger=0)
            self._connect()
        newest = dict(self._waiting(timeout))
        return {
            name: unpack(payload) if name[:7] != "camera/" else payload for name, payload in newest.items()
        }

    def receive_all(self, timeout: float) -> list[tuple[str, Any]]:
        """Return (stream, content) of every message within `timeout` seconds, in order, for streams of events."""
        return [(name, unpack(payload)) for name, payload in self._waiting(timeout)]

    def _waiting(self, timeout: float) -> list[tuple[str, bytes]]:
        messages = []
        wait = int(timeout * 1000)
        while self._socket.poll(wait):
            name, payload = self._socket.recv_multipart()
            messages.append((name.decode(), payload))
            wait = 0
        self._read_at = time.monotonic()
        return messages

    def close(self) -> None:
        self._socket.close()


class EventLog:
    """Newest events, numbered from 1 without gaps, so that a client can request the events that it missed."""

    def __init__(self) -> None:
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS_KEPT)
        self.newest = 0

    def append(self, event: Event) -> dict[str, Any]:
        """Number and store the event; return it as a dict for the wire."""
        self.newest += 1
        row = {
            "number": self.newest,
            "kind": event.kind,
            "text": event.text,
            "time": event.time,
            "wall": time.time(),
            "step": event.step,
            "data": dict(event.data),
            **sentence_fields(event),
        }
        self._events.append(row)
        return row

    def since(self, number: int) -> list[dict[str, Any]]:
        """Return all stored events after `number`."""
        return [event for event in self._events if event["number"] > number]
