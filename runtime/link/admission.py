"""Admission of connections to a lab: the keys of its stations, and any key while a code for enrolment is valid.

ZMQ asks during the handshake (ZAP, RFC 27), so that no message of a refused key is ever received.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import zmq

log = logging.getLogger(__name__)
_ZAP = "inproc://zeromq.zap.01"
_POLL_MS = 200
_KEY_BYTES = 32
_FRAMES = 7
_EVERY_S, _MOST_NAMES = 10.0, 64
_REFUSED_S, _MOST_NOTED = 30.0, 1024  # refusal after a broken bound [s]; greatest number of names remembered
# Handshakes of one key: burst, and rate [1/s]. Each connection gets the next of 2^32 routing numbers of the port, and
# libzmq aborts if a peer has chosen that number for itself: unlimited connections would reach it within an hour.
_AT_ONCE, _PER_S = 100.0, 10.0


@dataclass(frozen=True, slots=True)
class Allowed:
    """Admitted keys in hexadecimal, each with its station names; `enrolling`: unknown keys may connect to enrol."""

    stations: Mapping[str, frozenset[str]] = field(default_factory=lambda: MappingProxyType({}))
    enrolling: bool = False

    def may_connect(self, key: str) -> bool:
        """Return True if the key is admitted: as a station, or only to enrol."""
        return self.enrolling or key in self.stations

    def may_be(self, key: str, station: str) -> bool:
        """Return True if the key belongs to that station."""
        return station in self.stations.get(key, ())

    def names(self) -> set[str]:
        """Return the names of all stations that have a key."""
        return {name for names in self.stations.values() for name in names}


class AllowList:
    """Admitted keys (`now`), and keys and addresses that are refused for a while.

    The admissions are replaced as a whole; any thread may use them.
    """

    def __init__(self, allowed: Allowed | None = None) -> None:
        self.now = allowed or Allowed()
        # By key for stations, by address for all others:
        self._refused: dict[str, float] = {}  # end of the refusal
        self._spent: dict[str, tuple[float, float]] = {}  # handshakes in the bucket, and when it was updated
        self._lock = threading.Lock()

    def refuse(self, name: str, now: float) -> None:
        """Refuse `name` for `_REFUSED_S`: a station's key, or an address from which unknown keys connect."""
        with self._lock:
            _note(self._refused, name, now + _REFUSED_S)

    def refused(self, key: str, address: str, now: float) -> bool:
        """Record a handshake; return True if it must be refused.

        It is refused if its key is temporarily refused or makes too many handshakes. If no station has the key, its
        address is counted in place of the key.
        """
        name = key if key in self.now.stations else address
        with self._lock:
            spent, at = self._spent.get(name, (0.0, now))
            spent = max(0.0, spent - (now - at) * _PER_S)
            _note(self._spent, name, (min(spent + 1.0, _AT_ONCE), now))
            return spent > _AT_ONCE - 1.0 or now < self._refused.get(name, now)


def _note(noted: dict[str, Any], name: str, value: Any) -> None:
    noted.pop(name, None)
    noted[name] = value
    if len(noted) > _MOST_NOTED:
        del noted[next(iter(noted))]


class Seldom:
    """Log limiter: one line per name in ten seconds, and a bounded number of names, so that no flood fills the log."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._told: dict[str, float] = {}

    def due(self, name: str) -> bool:
        """Return True if a line about that name may be logged now."""
        now = self._clock()
        self._told = {text: at for text, at in self._told.items() if now - at < _EVERY_S}
        if name in self._told or len(self._told) >= _MOST_NAMES:
            return False
        self._told[name] = now
        return True


class Admission:
    """Thread that answers the handshakes of some ZMQ contexts (ZAP)."""

    def __init__(
        self,
        contexts: list[zmq.Context[Any]],
        allowed: AllowList,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._allowed, self._clock = allowed, clock
        self._seldom = Seldom()
        self._sockets = []
        for context in contexts:
            socket = context.socket(zmq.REP)
            socket.linger = 0
            socket.bind(_ZAP)
            self._sockets.append(socket)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="admission", daemon=True)

    def start(self) -> None:
        """Start the thread; call it before a socket listens."""
        self._thread.start()

    def end(self) -> None:
        """Stop the thread; no further connection is admitted."""
        self._ended.set()
        self._thread.join()
        for socket in self._sockets:
            socket.close(linger=0)

    def _work(self) -> None:
        poller = zmq.Poller()
        for socket in self._sockets:
            poller.register(socket, zmq.POLLIN)
        while not self._ended.is_set():
            for socket, _ in poller.poll(_POLL_MS):
                socket.send_multipart(self.answer(socket.recv_multipart()))

    def answer(self, frames: list[bytes]) -> list[bytes]:
        """Return the ZAP reply: 200 with the key as user id, 300 if refused for a while, or 400."""
        if len(frames) != _FRAMES or frames[5] != b"CURVE" or len(frames[6]) != _KEY_BYTES:
            request = frames[1] if len(frames) > 1 else b""
            return [b"1.0", request, b"400", b"CURVE alone is spoken here", b"", b""]
        key, address = frames[6].hex(), frames[3].decode("utf-8", "replace")
        if self._allowed.now.may_connect(key):
            if self._allowed.refused(key, address, self._clock()):
                return [b"1.0", frames[1], b"300", b"its connections broke a bound", b"", b""]
            return [b"1.0", frames[1], b"200", b"", key.encode(), b""]
        address = address.removeprefix("::ffff:")
        if self._seldom.due(address):
            log.warning("a key that no station here has was refused, from %.60s: %s", address, key)
        return [b"1.0", frames[1], b"400", b"no station of this lab has this key", b"", b""]
