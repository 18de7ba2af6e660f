"""Flow control of pages: a message quota, and a scheduler for requests.

The quota never counts stops. The scheduler starts only some requests in each turn of the event loop.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

PER_TURN = 8  # a request, or a websocket handshake, takes 1 ms or 2


class TurnScheduler:
    """Scheduler that starts at most `most` work items per turn of the event loop, in order.

    `soon` schedules a function for the next turn.
    """

    def __init__(self, soon: Callable[[Callable[[], None]], object], most: int = PER_TURN) -> None:
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
        batch = [self._waiting.popleft() for _ in range(min(self._most, len(self._waiting)))]
        self._planned = False
        self._plan()  # first, so that failing work does not block the others
        for work in batch:
            work()


PER_SECOND = 200.0  # a page that draws, renews and drags sends fewer than 150
AT_ONCE = 400.0


class MessageQuota:
    """Quota of a page's messages (token bucket): AT_ONCE messages in a burst, then PER_SECOND."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left, self._at = AT_ONCE, clock()

    def take(self, messages: int = 1) -> bool:
        """Take messages from the quota; return False if they exceed it."""
        now = self._clock()
        self._left = min(AT_ONCE, self._left + PER_SECOND * (now - self._at))
        self._at = now
        if self._left < messages:
            return False
        self._left -= messages
        return True
