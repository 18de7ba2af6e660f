"""Limit on the restarts of a process that ends again and again."""

from __future__ import annotations

from collections import deque

MOST_RESTARTS, RESTART_WINDOW_S = 5, 60.0


class RestartWindow:
    """Times of the restarts within the last minute, of which there are `MOST_RESTARTS` at most.

    Times are on the caller's clock [s].
    """

    def __init__(self) -> None:
        self._times: deque[float] = deque()

    def admit(self, now: float) -> bool:
        """Record a restart at `now`; return False, and record nothing, if it would exceed the limit."""
        while self._times and self._times[0] < now - RESTART_WINDOW_S:
            self._times.popleft()
        if len(self._times) >= MOST_RESTARTS:
            return False
        self._times.append(now)
        return True

    def clear(self) -> None:
        """Remove all recorded restarts."""
        self._times.clear()
