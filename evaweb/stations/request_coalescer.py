"""Coalescing of concurrent requests to stations: a repeated request is not sent again.

Each pending request has its own thread, so that a hanging station does not delay others. Requests with the same key
that arrive meanwhile share one further request, sent when the pending one is over: any number of simultaneous requests
causes only two.
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
    """Error if a station already has the allowed number of pending requests."""


@dataclass(slots=True)
class _PendingRequest(Generic[T]):
    identity: Hashable
    work: Callable[[], T]
    answer: Future[T] = field(default_factory=Future)


class RequestCoalescer(Generic[T]):
    """Pending requests to stations, in which requests with equal station and key can share an answer.

    It is thread-safe, and callers do not block. At most `most` different keys may be pending per station; None for no
    limit.
    """

    def __init__(self, name: str, most: int | None = None) -> None:
        self._name, self._most = name, most
        self._lock = Lock()
        self._under_way: dict[
            tuple[str, Hashable], list[_PendingRequest[T]]
        ] = {}  # the running request, then the next
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
        """Send the request `work`, unless an equal one is pending; return the future of the station's answer.

        If no request to the station with this `key` is pending, `work` is started. If one is pending with the same
        `identity`, this call shares the answer to that request. If one is pending with another `identity`, one further
        request is sent as soon as the pending one is over. All calls that arrive until then share this further request.

        Args:
            station: Name of the station.
            work: Function that sends the request and returns the answer.
            key: Kind of request; only requests with equal keys share answers.
            identity: Identity of this request; calls with an equal identity are repetitions of one request.
            shared: Return the answer to the pending request in every case; the further request is sent too.

        Raises:
            TooManyRequests: If too many requests with other keys are pending at the station.
        """
        place, flight = (station, key), _PendingRequest(identity, work)
        flight.answer.set_running_or_notify_cancel()  # shared by callers: one must not cancel it for others
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
        except RuntimeError as error:  # cannot start a thread: a stop is sent nevertheless
            log.error("%s %s has no thread of its own: %s", self._name, place, error)
            self._fly(place)

    def _fly(self, place: tuple[str, Hashable]) -> None:
        flight: _PendingRequest[T] | None = self._under_way[place][0]
        while flight is not None:
            try:
                answer = flight.work()
            except BaseException as fault:
                completed, flight = flight, self._next(place)
                completed.answer.set_exception(fault)
            else:
                completed, flight = flight, self._next(place)
                completed.answer.set_result(answer)

    def _next(self, place: tuple[str, Hashable]) -> _PendingRequest[T] | None:
        """Remove the finished request, so that no caller joins it, and return the waiting one."""
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
    for joined in flights:
        if joined.identity == flight.identity:
            return joined.answer
    if len(flights) == 1:
        flights.append(flight)
    return flights[0 if shared else 1].answer
