"""Scheduling of requests over turns of the event loop, so that many requests do not delay connected clients."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

AT_ONCE = 8  # a request, or a websocket handshake, takes 1 ms or 2


class TurnScheduler:
    """Scheduler that starts at most `most` work items per turn of the event loop, in order.

    `soon` schedules a function for the next turn.
    """

    def __init__(self, soon: Callable[[Callable[[], None]], object], most: int = AT_ONCE) -> None:
        self._soon, self._most = soon, most
        self._waiting: deque[Callable[[], object]] = deque()
        self._planned = False

    def submit(self, work: Callable[[], object]) -> None:
        """Queue `work`."""
        self._waiting.append(work)
        self._plan()

    def _plan(self) -> None:
        if self._waiting and not self._planned:
            self._planned = True
            self._soon(self._turn)

    def _turn(self) -> None:
        taken = [self._waiting.popleft() for _ in range(min(self._most, len(self._waiting)))]
        self._planned = False
        self._plan()  # first, so that failing work does not block the others
        for work in taken:
            work()
