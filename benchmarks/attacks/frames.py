"""Attacks by pages that send many messages: to a dead station, or without permission."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from typing import Any
from uuid import uuid4

from websockets.exceptions import ConnectionClosed

from benchmarks.attacks.requests import again_and_again, long_to_parse
from benchmarks.attacks.target import Target
from benchmarks.estop_lab import OTHER, PRESSED
from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.stall_detection import DemoFailed
from runtime.ipc.bus import Endpoints

_STOPS, _PRESSES = 5000, 1500
_SLOW = 2 << 20
_QUIET_S = 5.0  # time without an answer after which no more are expected


class _Page(LivePage):
    """Page that counts acknowledgements and does nothing else."""

    def __init__(self, visitor: RestClient, station: str) -> None:
        self.answered = 0
        super().__init__(visitor, station)

    @property
    def closed(self) -> bool:
        return bool(self._failure)

    def send(self, message: Mapping[str, Any], times: int) -> None:
        """Send a message `times` times, each time with a new uuid."""
        for _ in range(times):
            self._send({**message, "uuid": str(uuid4())})

    def shout(self, text: str) -> None:
        """Send a text as a message without changing it."""
        try:
            self._socket.send(text)
        except ConnectionClosed as error:
            self._fail(str(error))

    def _on_message(self, message: Mapping[str, Any]) -> None:
        self.answered += message.get("type") == "ack"


def dead_station(target: Target) -> Counter[str]:
    """Press the e-stop of a station whose guard and coordinator are stopped."""
    message = {"type": "estop", "why": "somebody leans on it"}
    with _stopped(target, "guard", "coordinator"):
        return _waves(target, OTHER, message, target.part(_PRESSES))


def viewer_stops(target: Target) -> Counter[str]:
    """Send stop commands as a user who may not command the station."""
    return _waves(target, PRESSED, {"type": "stop", "epoch": 0}, target.part(_STOPS))


def slow_frames(target: Target) -> Counter[str]:
    """Send messages of 2 MiB that are slow to parse, over two sockets of a viewer."""
    visitor = target.visitor("viewer")
    texts = [long_to_parse(target.part(_SLOW), number) for number in (0, 1)]

    def shouts(target: Target, number: int) -> str:
        with closing(_Page(visitor, PRESSED)) as page:
            sent = 0
            while not target.ended.is_set() and not page.closed:
                page.shout(texts[sent % 2])
                sent += 1
            return f"closed after {sent}"

    return again_and_again(target, 2, shouts)


@contextmanager
def _stopped(target: Target, *processes: str) -> Iterator[None]:
    """Pause processes of the other station (SIGSTOP) within the context."""
    endpoints = Endpoints(target.data / "stations" / OTHER).read("supervisor")
    pids = [int(endpoints[process]) for process in processes]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


def _waves(target: Target, station: str, message: Mapping[str, Any], times: int) -> Counter[str]:
    """Send `times` messages, wait for the answers, and repeat; a closed page is reopened.

    Return the number of pages, messages, answers and refused connections.
    """
    counts: Counter[str] = Counter()
    visitor = target.visitor("viewer")
    while not target.ended.is_set():
        try:
            with closing(_Page(visitor, station)) as page:
                counts["pages"] += 1
                while not target.ended.is_set() and not page.closed:
                    page.send(message, times)
                    counts["sent"] += times
                    if counts["sent"] == times:
                        target.begun()
                    _await(target, page, counts["sent"])
                counts["answered"] += page.answered
        except DemoFailed:
            counts["refused"] += 1
            target.ended.wait(0.5)
    return counts


def _await(target: Target, page: _Page, sent: int) -> None:
    """Wait until all `sent` messages are answered, or until no more answers arrive."""
    answers, since = page.answered, time.monotonic()
    while page.answered < sent and not page.closed and not target.ended.wait(0.05):
        if page.answered != answers:
            answers, since = page.answered, time.monotonic()
        elif time.monotonic() - since > _QUIET_S:
            return
