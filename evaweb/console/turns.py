"""Requests take turns of the event loop: a crowd keeps no connected client from being heard."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

AT_ONCE = 8  # a request, or the handshake of a websocket, is 1 ms or 2


class TurnScheduler:
    """Work of which `most` is begun in one turn of the loop, the rest in those that follow, in order.

    `soon` has something done in the next turn.
    """

    def __init__(self, soon: Callable[[Callable[[], None]], object], most: int = AT_ONCE) -> None:
        self._soon, self._most = soon, most
        self._waiting: deque[Callable[[], object]] = deque()
        self._planned = False

    def submit(self, work: Callable[[], object]) -> None:
        """Have it done."""
        self._waiting.append(work)
        self._plan()

    def _plan(self) -> None:
        if self._waiting and not self._planned:
            self._planned = True
            self._soon(self._turn)

    def _turn(self) -> None:
        taken = [self._waiting.popleft() for _ in range(min(self._most, len(self._waiting)))]
        self._planned = False
        self._plan()  # first: work that fails keeps no other waiting
        for work in taken:
            work()
