"""The station's sockets: commands in, snapshots and pictures out, numbered events.

Knows nothing of robots. Clients find the sockets in the station's folder, where each process of the family
leaves its endpoints.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import zmq

from runtime.codecs import pack, unpack
from runtime.errors import CodecError, TransportError
from runtime.messages import Ack, Command, Event, decode, encode

# What a client needs to talk to a station, with the errors that it may meet: this module is a door.
__all__ = [
    "CodecError",
    "CommandClient",
    "CommandServer",
    "Endpoints",
    "EventLog",
    "Publisher",
    "Subscriber",
    "TransportError",
    "bind",
]

log = logging.getLogger(__name__)
RETRY_S = 1.0
# What a publisher queues per reader that does not keep up, beyond which ZMQ drops the newest. It counts a
# queue as emptied only when half of it is, so it has to take two bursts: all events, all cameras at once.
STREAM_HIGH_WATER = 64
CAMERA_HIGH_WATER = 16
# A reader that comes rarely must find everything in its own queue, else the newest is hidden behind the old.
_READER_HIGH_WATER = 256
_AWAY_S = 1.0
EVENTS_KEPT = 2000


class Endpoints:
    """Where a station's sockets are: one small file per process in the station's folder."""

    def __init__(self, station_dir: Path) -> None:
        self._folder = station_dir / "endpoints"
        self._wanted: dict[str, str] = {}  # by process, what is not on disk yet
        self._lock = threading.Lock()

    def write(self, process: str, endpoints: Mapping[str, str]) -> bool:
        """Leave this process's endpoints, replacing those of its predecessor at once.

        Where the disk refuses, a line in the log says so, and a thread tries again once a second until it does
        not: the work of the process does not depend on it. Returns whether they are there.
        """
        with self._lock:
            retried = bool(self._wanted)
            self._wanted[process] = json.dumps({**endpoints, "pid": os.getpid()})
            failure = self._try()
        if failure is not None:
            log.error(
                "clients cannot find the process %s until the disk takes its file: %s", process, failure
            )
            if not retried:
                threading.Thread(target=self._retry, name="endpoints", daemon=True).start()
        return failure is None

    def _retry(self) -> None:
        while True:
            time.sleep(RETRY_S)
            with self._lock:
                if self._try() is None:
                    return

    def _try(self) -> OSError | None:
        """Write what is wanted; the error that kept some of it from the disk."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            for process in list(self._wanted):
                new = self._folder / f".{process}.{os.getpid()}"
                new.write_text(self._wanted[process], "utf-8")
                new.replace(self._folder / f"{process}.json")
                del self._wanted[process]
        except OSError as error:
            return error
        return None

    def read(self, process: str) -> dict[str, Any]:
        """The endpoints of `process`; raises TransportError where the station has none."""
        path = self._folder / f"{process}.json"
        try:
            found: dict[str, Any] = json.loads(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            station = self._folder.parent
            known = ", ".join(sorted(p.parent.name for p in station.parent.glob("*/endpoints"))) or "none"
            raise TransportError(
                f"station {station.name!r} is not running here ({path}: {error.__class__.__name__}); "
                f"start it with python -m runtime DEPLOYMENT, or name another data folder (looked in "
                f"{station.parent}, running or once run: {known})"
            ) from None
        return found

    def clear(self) -> None:
        """Remove what a former family left, and forget what is not written yet."""
        with self._lock:
            self._wanted.clear()
        for path in self._folder.glob("*.json"):
            path.unlink(missing_ok=True)


def bind(context: zmq.Context[Any], kind: int, host: str, port: int, high_water: int) -> tuple[Any, str]:
    """A bound socket and its endpoint; port 0 takes a free one. Raises TransportError where taken."""
    socket = context.socket(kind)
    socket.set_hwm(high_water)
    socket.linger = 0
    try:
        socket.bind(f"tcp://{host}:{port or '*'}")
    except zmq.ZMQError as error:
        socket.close()
        raise TransportError(
            f"cannot listen on {host}:{port}: {error.strerror}; name another port in [bus]"
        ) from None
    return socket, socket.last_endpoint.decode()


class CommandServer:
    """The answering end of commands: a ROUTER that never blocks its owner."""

    def __init__(self, context: zmq.Context[Any], host: str, port: int) -> None:
        self.socket, self.endpoint = bind(context, zmq.ROUTER, host, port, 1000)

    def receive(self) -> tuple[list[bytes], Command] | None:
        """The next command with the address to answer to; None where there is none.

        What cannot be read is answered with a refusal that says why, and never ends the caller.
        """
        while True:
            try:
                *address, payload = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return None
            try:
                message = decode(payload)
            except CodecError as error:
                self.answer(address, Ack("", "refused", str(error)))
                continue
            if isinstance(message, Command):
                return address, message
            self.answer(address, Ack("", "refused", f"expected a Command, got {type(message).__name__}"))

    def answer(self, address: list[bytes], ack: Ack) -> None:
        """Send the answer; a client that is gone loses it."""
        self.socket.send_multipart([*address, encode(ack)], zmq.NOBLOCK)

    def close(self) -> None:
        self.socket.close()


class CommandClient:
    """The asking end: one command at a time, each with a deadline.

    After a timeout the connection is dropped with all that is under way on it, in both directions: a late
    answer is never taken for another's, and a command that was not sent is not delivered hours later.
    """

    def __init__(self, context: zmq.Context[Any], endpoint: str) -> None:
        self._context = context
        self._endpoint = endpoint
        self._connect()

    def _connect(self) -> None:
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.linger = 200
        self._socket.connect(self._endpoint)

    def request(self, command: Command, timeout: float) -> Ack:
        """The answer; raises TransportError "outcome unknown" where none came in time."""
        self._socket.send(encode(command))
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0:
            if not self._socket.poll(int(left * 1000) + 1):
                continue
            answer = decode(self._socket.recv())
            if isinstance(answer, Ack) and answer.uuid in (command.uuid, ""):
                return answer
        self._socket.close(linger=0)
        self._connect()
        raise TransportError(f"no answer to {command.kind} within {timeout:g} s: outcome unknown")

    def close(self) -> None:
        self._socket.close()


class Publisher:
    """Sends newest-wins streams; a reader that is too slow misses some."""

    def __init__(self, context: zmq.Context[Any], host: str, port: int, high_water: int) -> None:
        self._socket, self.endpoint = bind(context, zmq.PUB, host, port, high_water)

    def publish(self, stream: str, payload: object) -> None:
        """Send `payload` under the name `stream`; never waits."""
        content = payload if isinstance(payload, bytes) else pack(payload)
        self._socket.send_multipart([stream.encode(), content], zmq.NOBLOCK)

    def close(self) -> None:
        self._socket.close()


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
        }
        self._events.append(row)
        return row

    def since(self, number: int) -> list[dict[str, Any]]:
        """Every kept event after `number`."""
        return [event for event in self._events if event["number"] > number]
