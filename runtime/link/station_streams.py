"""Streams of a station on their way to its lab: the newest message of each, within the credit that the lab grants.

On a slow link messages are sent less often, never late: a waiting message is replaced by a newer one.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from runtime.ipc.bus import Endpoints
from runtime.link.wire import COORDINATOR, MEDIA, MOST_PARTS, STATE, Bundle, Credit

_READER_HIGH_WATER = 256
_TURN = 500  # messages read per turn
_LOOK_EVERY = 20  # turns between two checks of the endpoint
_MOST_CREDIT = 64


@dataclass(frozen=True, slots=True)
class Source:
    """Publishing socket of the station, identified by its process and its name."""

    endpoints: Endpoints
    process: str
    socket: str

    def endpoint(self) -> str:
        """Return the current endpoint; "" if there is none."""
        return self.endpoints.address(self.process, self.socket)


def source_of(station_dir: Path, role: str) -> Source:
    """Return the socket whose messages a connection of `role` carries."""
    endpoints = Endpoints(station_dir)
    return Source(endpoints, COORDINATOR, "state") if role == STATE else Source(endpoints, MEDIA, "cameras")


class Flow:
    """Streams of one socket: subscribed while the lab wants any, and sent in bundles as the lab's credit allows."""

    def __init__(self, context: zmq.Context[Any], source: Source) -> None:
        self._context, self._source = context, source
        self.socket: zmq.Socket[Any] | None = None
        self._endpoint = ""
        self._wanted: list[str] = []
        self._credit = 0
        self._newest: dict[str, bytes] = {}
        self._turns = 0

    def stop(self) -> None:
        """Discard the lab's credit and requests, and unsubscribe."""
        self._credit, self._wanted = 0, []
        self._newest.clear()
        self._disconnect()

    def allow(self, credit: Credit) -> None:
        """Add the lab's credit, and subscribe to the streams whose names start with the given prefixes."""
        self._credit = min(self._credit + max(0, credit.count), _MOST_CREDIT)
        if credit.wanted != self._wanted:
            self._wanted = credit.wanted
            self._newest.clear()
            self._disconnect()

    def bundle(self) -> tuple[Bundle, list[bytes]] | None:
        """Return the new messages as a bundle; None if there are none or the lab has granted no credit."""
        self._receive()
        if not self._credit or not self._newest:
            return None
        names = list(self._newest)[:MOST_PARTS]
        self._credit -= 1
        return Bundle(names), [self._newest.pop(name) for name in names]

    def close(self) -> None:
        """Release the socket."""
        self._disconnect()

    def _receive(self) -> None:
        self._turns += 1
        if self._wanted and (self.socket is None or self._turns % _LOOK_EVERY == 0):
            self._connect(self._source.endpoint())
        if self.socket is None:
            return
        with suppress(zmq.Again):
            for _ in range(_TURN):
                parts = self.socket.recv_multipart(zmq.NOBLOCK)
                if len(parts) == 2:
                    self._newest[parts[0].decode("utf-8", "replace")] = parts[1]

    def _connect(self, endpoint: str) -> None:
        if endpoint == self._endpoint and self.socket is not None:
            return
        self._disconnect()
        if not endpoint:
            return
        self._endpoint = endpoint
        self.socket = self._context.socket(zmq.SUB)
        self.socket.set_hwm(_READER_HIGH_WATER)
        for name in self._wanted:
            self.socket.subscribe(name.encode())
        self.socket.connect(endpoint)

    def _disconnect(self) -> None:
        if self.socket is not None:
            self.socket.close(linger=0)
        self.socket, self._endpoint = None, ""
