"""Requests to stations that are under way: one that says the same again does not go out again.

Each has a thread of its own, so that a station that hangs keeps none of another's waiting. What comes under the same
key while one is under way is at most one more request, sent when that one is over: a flood costs two.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import dataclass, field
from threading import Lock, Thread
from typing import Generic, TypeVar

from runtime.core.sentences import Pattern

log = logging.getLogger(__name__)
_REQUESTS_UNDER_WAY = Pattern(
    "stations.flights.requests_under_way",
    "{most} requests to {station} are under way",
)
T = TypeVar("T")


class TooManyRequests(Exception):
    """More requests to one station are under way than it may have."""


@dataclass(slots=True)
class _PendingRequest(Generic[T]):
    identity: Hashable
    work: Callable[[], T]
    answer: Future[T] = field(default_factory=Future)


class RequestCoalescer(Generic[T]):
    """Requests to stations under way; from any thread, and none of its callers waits.

    `most` is how many keys of one station may be under way at once, None for any number.
    """

    def __init__(self, name: str, most: int | None = None) -> None:
        self._name, self._most = name, most
        self._lock = Lock()
        self._under_way: dict[
            tuple[str, Hashable], list[_PendingRequest[T]]
        ] = {}  # the one that flies, the next
        self._keys: Counter[str] = Counter()  # by station

    def submit(
        self,
        station: str,
        work: Callable[[], T],
        *,
        key: Hashable = None,
        identity: Hashable,
        shared: bool = False,
    ) -> Future[T]:
        """The answer to `work`, or to the same that is under way already.

        The same `identity` gets the same answer. Another one of that `key` gets the answer of one request more,
        which is sent after it came; where it is `shared`, that of the one under way, and that request is made all
        the same. Raises TooMany.
        """
        place, flight = (station, key), _PendingRequest(identity, work)
        flight.answer.set_running_or_notify_cancel()  # who stops waiting for it ends nobody else's
        with self._lock:
            flights = self._under_way.get(place)
            if flights is not None:
                return _joined(flights, flight, shared)
            if self._most is not None and self._keys[station] >= self._most:
                raise TooManyRequests(_REQUESTS_UNDER_WAY(most=self._most, station=station))
            self._under_way[place] = [flight]
            self._keys[station] += 1
        self._start(place)
        return flight.answer

    def _start(self, place: tuple[str, Hashable]) -> None:
        try:
            Thread(target=self._fly, args=(place,), name=self._name, daemon=True).start()
        except RuntimeError as error:  # no more threads: what stops a robot is done all the same
            log.error("%s %s has no thread of its own: %s", self._name, place, error)
            self._fly(place)

    def _fly(self, place: tuple[str, Hashable]) -> None:
        flight: _PendingRequest[T] | None = self._under_way[place][0]
        while flight is not None:
            try:
                answer = flight.work()
            except BaseException as fault:
                done, flight = flight, self._next(place)
                done.answer.set_exception(fault)
            else:
                done, flight = flight, self._next(place)
                done.answer.set_result(answer)

    def _next(self, place: tuple[str, Hashable]) -> _PendingRequest[T] | None:
        """The one that waited, which flies now; no caller joins the one that is over."""
        with self._lock:
            flights = self._under_way[place]
            flights.pop(0)
            if flights:
                return flights[0]
            del self._under_way[place]
            self._keys[place[0]] -= 1
            if not self._keys[place[0]]:
                del self._keys[place[0]]
            return None


def _joined(flights: list[_PendingRequest[T]], flight: _PendingRequest[T], shared: bool) -> Future[T]:
    for one in flights:
        if one.identity == flight.identity:
            return one.answer
    if len(flights) == 1:
        flights.append(flight)
    return flights[0 if shared else 1].answer
