"""The station's sockets: commands in, snapshots and pictures out, numbered events.

Knows nothing of robots. The sockets are Unix sockets in a folder of this account's own; clients find them in the
station's folder, where each process of the family leaves its endpoints.
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
from runtime.ipc.messages import Ack, Command, Event, decode, encode, told_by
from runtime.ipc.readable import readable

_TOO_MANY = Pattern(
    "bus.too_many",
    "more than {most} requests at once over one connection: wait for answers; stops are obeyed",
)
_NO_COMMAND = Pattern("bus.no_command", "expected a Command, got {kind}")
_NO_ANSWER = Pattern("bus.no_answer", "no answer to {kind} within {seconds:g} s: outcome unknown")
_TOO_LARGE = Pattern("bus.too_large", "{kind} has {given} bytes; allowed: {most}")

# What a client needs to talk to a station, with the errors that it may meet: this module is a door.
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
# What a publisher queues per reader that does not keep up, beyond which ZMQ drops the newest. It counts a
# queue as emptied only when half of it is, so it has to take two bursts: all events, all cameras at once.
STREAM_HIGH_WATER = 64
CAMERA_HIGH_WATER = 16
# A reader that comes rarely must find everything in its own queue, else the newest is hidden behind the old.
_READER_HIGH_WATER = 256
_AWAY_S = 1.0
EVENTS_KEPT = 2000


# Of sockets that others connect to: who connects and never says what he is, is gone after a second; one that does not
# live is let go; nobody's message is larger than any of ours.
_HANDSHAKE_MS, _HEARTBEAT_MS, _SILENT_MS = 1000, 5000, 20_000
_BACKLOG = 1024
_LOOK_S = LOOK_S
LARGEST = 256 << 10  # bytes of a command
_QUEUED = 256  # commands of one connection, before it has to wait
_UNREAD = (
    2000  # answers that a connection has not read, beyond which it loses them: more than those of one turn
)
MAX_WAITING_PER_CONNECTION = 32  # requests of one connection that may wait; what is beyond is refused
MAX_MESSAGES_PER_TURN = 1000  # messages that are taken from a socket in one turn
TOO_MANY = _TOO_MANY(most=MAX_WAITING_PER_CONNECTION)


class Listener:
    """A socket that listens in the station's folder of sockets; `endpoint` says where. Raises TransportError."""

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
        """Listen anew where clients cannot connect, or others could; True where it has another endpoint now.

        A session's folder goes with the last logout of its account, and its mode or owner may change. Who is connected
        stays so. Looks five times a second.
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
                log.error("nobody can connect to %s at %s: %s", self._name, self._path, error)
            return False
        log.warning(
            "clients cannot connect to %s any more, or others can: it is %s now", self._name, self._path
        )
        return True

    def close(self) -> None:
        """Release the socket."""
        self.socket.close()
        self._path.unlink(missing_ok=True)  # which ZMQ leaves


@dataclass(frozen=True, slots=True)
class IncomingMessage:
    """One message as it came: from whom, what, signed how (empty: not at all), and of which account and process.

    None where the kernel does not say which.
    """

    address: list[bytes]
    payload: bytes
    signature: bytes
    uid: int | None
    pid: int | None


def _call(frames: list[zmq.Frame]) -> IncomingMessage:
    """A message of a ROUTER: the connection, the empty frame of those that have one, content, signature.

    What has more frames than that has a signature of all of them, which is none.
    """
    body = 2 if len(frames) > 2 and not len(frames[1]) else 1
    address = [frame.bytes for frame in frames[:body]]
    payload = frames[body].bytes if len(frames) > body else b""
    signature = b"".join(frame.bytes for frame in frames[body + 1 :])
    return IncomingMessage(address, payload, signature, *_peer(frames[-1]))


def _peer(frame: zmq.Frame) -> tuple[int | None, int | None]:
    """The account and the process that connected, as the kernel told ZMQ: "localhost:UID:GID:PID"."""
    try:
        _, uid, _, pid = str(frame["Peer-Address"]).split(":")
        return int(uid), int(pid)
    except (zmq.ZMQError, KeyError, ValueError):
        return None, None


@lru_cache(maxsize=8)  # cache: a flood is refused for one reason
def _refusal(reason: str) -> bytes:
    return encode(Ack("", "refused", reason))


class CommandServer(Listener):
    """The answering end of commands: a ROUTER that never blocks its owner."""

    def __init__(self, context: zmq.Context[Any], station_dir: Path, name: str) -> None:
        super().__init__(context, zmq.ROUTER, station_dir, name, _QUEUED, _UNREAD)

    def receive(self) -> tuple[IncomingMessage, Command] | None:
        """The next command, and how it came; None where there is none.

        What cannot be read is answered with a refusal that says why, and never ends the caller.
        """
        while (call := self.receive_raw()) is not None:
            if (command := self.decode(call)) is not None:
                return call, command
        return None

    def receive_raw(self) -> IncomingMessage | None:
        """The next message, unread; None where there is none."""
        if not readable(self.socket):
            return None
        try:
            return _call(self.socket.recv_multipart(zmq.NOBLOCK, copy=False))
        except zmq.Again:
            return None

    def decode(self, call: IncomingMessage) -> Command | None:
        """The command that came; where it is none, that is answered with the reason."""
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
        """Refuse what nobody has read, so that its uuid is not known."""
        self._send(call, _refusal(reason))

    def answer(self, call: IncomingMessage, ack: Ack) -> None:
        """Send the answer; a client that is gone, or reads none of them, loses it."""
        self._send(call, encode(ack))

    def pass_on(self, call: IncomingMessage, payload: bytes) -> None:
        """Send an answer as another station has packed it."""
        self._send(call, payload)

    def _send(self, call: IncomingMessage, payload: bytes) -> None:
        self.socket.send_multipart([*call.address, payload], zmq.NOBLOCK)


class CommandClient:
    """The asking end: one command at a time, each with a deadline.

    After a timeout the connection is dropped with all that is under way on it, in both directions: a late
    answer is never taken for another's, and a command that was not sent is not delivered hours later.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        key: Key | None = None,
        owner: int | None = None,
    ) -> None:
        """`owner` is the account whose station it is: nobody else's answer counts, but this account's and root's."""
        self._context = context
        self._believed = {os.geteuid(), 0, owner}
        self.strangers = ""  # who answered instead
        self._endpoint = endpoint
        self._key = key
        self._connect()

    def _connect(self) -> None:
        self._socket: zmq.Socket[Any] = self._context.socket(zmq.DEALER)
        self._socket.linger = 200
        self._socket.connect(self._endpoint)

    def send(self, command: Command) -> None:
        """Send it; its answer, if one comes, is nobody's. Raises CodecError for too large a one.

        It is signed where there is a key; one that is of no use keeps nothing from being sent.
        """
        self._socket.send_multipart(self._signed(command))

    def request(self, command: Command, timeout: float) -> Ack:
        """Its answer, as `post`; raises TransportError "outcome unknown" where none came in time."""
        self.send(command)
        answer = self.receive_answer(command, timeout)
        if answer is not None:
            return answer
        self._socket.close(linger=0)
        self._connect()
        raise TransportError(_NO_ANSWER(kind=command.kind, seconds=timeout))

    def receive_answer(self, command: Command, timeout: float) -> Ack | None:
        """The answer to what was posted; None where none came in time."""
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
        """For a poller: it can be read where an answer has come."""
        return self._socket

    def forward(self, payload: bytes, signature: bytes) -> None:
        """Send a command as another process has packed it, with that signature."""
        self._socket.send_multipart([payload, signature], zmq.NOBLOCK)

    def packed_answer(self) -> bytes | None:
        """The next answer that has come, unread; None where there is none, or a stranger gave it."""
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
    """Sends newest-wins streams; a reader that is too slow misses some. Knows which of them anybody reads."""

    def __init__(self, context: zmq.Context[Any], station_dir: Path, name: str, high_water: int) -> None:
        super().__init__(context, zmq.XPUB, station_dir, name, high_water, high_water)
        self.topics: set[str] = set()  # how the names of the streams begin that somebody reads

    def hear(self) -> list[str]:
        """Learn who reads what by now; the topics that nobody read before."""
        begun = []
        with suppress(zmq.Again):
            while readable(self.socket):
                told = self.socket.recv(zmq.NOBLOCK)
                topic = told[1:].decode("utf-8", "replace")
                if told[:1] == b"\x01":
                    self.topics.add(topic)
                    begun.append(topic)
                elif told[:1] == b"\x00":
                    self.topics.discard(topic)
        return begun

    def wanted(self, stream: str) -> bool:
        """True if somebody reads `stream`, as far as was heard."""
        return any(stream.startswith(topic) for topic in self.topics)

    def publish(self, stream: str, payload: object) -> None:
        """Send `payload` under the name `stream`; never waits."""
        content = payload if isinstance(payload, bytes) else pack(payload)
        self.socket.send_multipart([stream.encode(), content], zmq.NOBLOCK)


class Subscriber:
    """Receives streams by name prefix, newest of each."""

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
        """The newest content of every stream that had something within `timeout` seconds.

        Who was away for more than a second is connected anew, which takes some milliseconds: what has piled
        up meanwhile, here and in the kernel, is old.
        """
        if time.monotonic() - self._read_at > _AWAY_S:
            self._socket.close(linger=0)
            self._connect()
        newest: dict[str, bytes] = {}
        wait = int(timeout * 1000)
        while self._socket.poll(wait):
            name, payload = self._socket.recv_multipart()
            newest[name.decode()] = payload
            wait = 0
        self._read_at = time.monotonic()
        return {
            name: unpack(payload) if name[:7] != "camera/" else payload for name, payload in newest.items()
        }

    def close(self) -> None:
        self._socket.close()


class EventLog:
    """The last events, numbered from 1 without gaps, so that a client can ask for what it missed."""

    def __init__(self) -> None:
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS_KEPT)
        self.newest = 0

    def append(self, event: Event) -> dict[str, Any]:
        """Number the event and keep it; returns it as a map."""
        self.newest += 1
        row = {
            "number": self.newest,
            "kind": event.kind,
            "text": event.text,
            "time": event.time,
            "wall": time.time(),
            "step": event.step,
            "data": dict(event.data),
            **told_by(event),
        }
        self._events.append(row)
        return row

    def since(self, number: int) -> list[dict[str, Any]]:
        """Every kept event after `number`."""
        return [event for event in self._events if event["number"] > number]
