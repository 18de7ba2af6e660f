"""Relay of the lab's requests to the sockets of the station on this computer, and of the answers back.

Each pending request uses a connection of its own, like that of a local program. So no request is refused because others
are pending, and a late answer is never matched to another request.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zmq

from runtime.core.errors import TransportError
from runtime.ipc.bus import CommandClient, Endpoints
from runtime.ipc.endpoints import LOOK_S
from runtime.link.wire import COORDINATOR, GUARD

log = logging.getLogger(__name__)
ALLOWED = ((GUARD, "estop"), (COORDINATOR, "commands"))
_MOST = 64  # pending requests; at this number the oldest is dropped
_PATIENCE_S = 30.0  # [s], for an answer; the lab does not wait longer
_FIND_S, _TELL_S = 5.0, 0.8  # [s]: search for the socket of a stop; first answer to its sender


@dataclass(slots=True)
class _PendingQuestion:
    process: str
    socket: str
    payload: bytes
    signature: bytes
    stops: bool
    since: float
    looked: float
    told: bool = False
    endpoint: str = ""
    client: CommandClient | None = None


@dataclass(slots=True)
class _Free:
    """Connections to one socket that are not in use."""

    endpoint: str
    clients: list[CommandClient] = field(default_factory=list)

    def close(self) -> None:
        for client in self.clients:
            client.close()


@dataclass(frozen=True, slots=True)
class Answered:
    """Answer to the request `number`.

    `packed` is the answer as the station encoded it; if there is none, `failure` is the reason.
    """

    number: int
    packed: bytes = b""
    failure: str = ""


class Relay:
    """Requests that wait for the station's answer. One thread uses it."""

    def __init__(
        self, context: zmq.Context[Any], station_dir: Path, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._context, self._clock = context, clock
        self._endpoints = Endpoints(station_dir)
        self._asked: dict[int, _PendingQuestion] = {}
        self._free: dict[tuple[str, str], _Free] = {}

    def send(
        self, number: int, place: tuple[str, str], payload: bytes, signature: bytes, stops: bool
    ) -> None:
        """Send a request to the station's socket.

        Args:
            number: Number of the request, repeated in its `Answered`.
            place: Process and name of the socket.
            payload: Packed command.
            signature: Signature of the payload for the station's command server.
            stops: Whether it is a stop: it is sent again if its socket moves while the answer is pending.
        """
        if len(self._asked) >= _MOST:
            self._end(next(iter(self._asked)))
        now = self._clock()
        question = self._asked[number] = _PendingQuestion(*place, payload, signature, stops, now, now)
        self._send(question)

    @property
    def is_pending(self) -> bool:
        """True while requests wait for the station."""
        return bool(self._asked)

    def sockets(self) -> list[zmq.Socket[Any]]:
        """Return the sockets of pending requests; each becomes readable when its answer arrives."""
        return [question.client.socket for question in self._asked.values() if question.client is not None]

    def answers(self) -> list[Answered]:
        """Return the answers that have arrived and the requests that have failed."""
        now, answers = self._clock(), []
        for number, question in list(self._asked.items()):
            packed = question.client.packed_answer() if question.client is not None else None
            if packed is not None:
                answers.append(Answered(number, packed))
                self._store(question)
                del self._asked[number]
            elif (
                question.client is None
                and not question.told
                and (not question.stops or now - question.since > _TELL_S)
            ):
                answers.append(
                    Answered(number, failure="the station does not run on its computer: start it there")
                )
                question.told = True
            elif question.client is None and (not question.stops or now - question.since > _FIND_S):
                del self._asked[number]
            elif now - question.since > _PATIENCE_S:
                self._end(number)
            elif question.stops and now - question.looked > LOOK_S / 4:
                question.looked = now
                self._send(question)
        return answers

    def forget(self) -> None:
        """Drop all pending requests; commands that were sent are executed nevertheless."""
        for number in list(self._asked):
            self._end(number)

    def listening(self) -> list[str]:
        """Return the processes of the station whose sockets exist."""
        return [process for process in (GUARD, COORDINATOR, "media") if self._is_there(process)]

    def close(self) -> None:
        """Release all sockets."""
        self.forget()
        for free in self._free.values():
            free.close()
        self._free.clear()

    def _send(self, question: _PendingQuestion) -> None:
        """Send the request to the current endpoint of its socket, unless it was sent there already."""
        endpoint = self._endpoints.address(question.process, question.socket)
        if not endpoint or endpoint == question.endpoint:
            return
        if question.client is not None:
            self._taken(question).close()
        question.endpoint, question.client = (
            endpoint,
            self._client((question.process, question.socket), endpoint),
        )
        try:
            question.client.forward(question.payload, question.signature)
        except zmq.ZMQError as error:  # the queue is full: the station does not read
            log.warning("%s takes no more: %s", endpoint, error.strerror)

    def _client(self, place: tuple[str, str], endpoint: str) -> CommandClient:
        free = self._free.get(place)
        if free is None or free.endpoint != endpoint:  # the station has restarted, or its socket has moved
            if free is not None:
                free.close()
            free = self._free[place] = _Free(endpoint)
        if free.clients:
            return free.clients.pop()
        return CommandClient(self._context, endpoint, owner=self._endpoints.owner)

    def _store(self, question: _PendingQuestion) -> None:
        free, client = self._free[question.process, question.socket], self._taken(question)
        if free.endpoint == question.endpoint:
            free.clients.append(client)
        else:
            client.close()

    def _taken(self, question: _PendingQuestion) -> CommandClient:
        client, question.client = question.client, None
        assert client is not None
        return client

    def _end(self, number: int) -> None:
        question = self._asked.pop(number)
        if question.client is not None:
            question.client.close()

    def _is_there(self, process: str) -> bool:
        try:
            sockets = self._endpoints.read(process)
        except TransportError:
            return False
        places = [str(place) for place in sockets.values() if str(place).startswith("ipc://")]
        return bool(places) and all(Path(place.removeprefix("ipc://")).exists() for place in places)
