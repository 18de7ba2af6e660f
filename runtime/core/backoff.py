"""When to try again what has failed: soon at first, then less and less often."""

from __future__ import annotations

_FIRST_S, _LONGEST_S = 0.1, 2.0


class BackOff:
    """Doubles the wait with every failure; a success forgets them. Times are the caller's clock [s]."""

    def __init__(self, first: float = _FIRST_S, longest: float = _LONGEST_S) -> None:
        self._first, self._longest = first, longest
        self.reset()

    def reset(self) -> None:
        """Nothing has failed."""
        self._failures = 0
        self._due = float("-inf")
        self.since: float | None = None  # the first of the failures in a row

    def record_failure(self, now: float) -> None:
        """Once more."""
        self.since = now if self.since is None else self.since
        self._due = now + min(self._longest, self._first * 2.0 ** min(self._failures, 32))
        self._failures += 1

    def remaining_delay(self, now: float) -> float:
        """For how long nothing is to be tried [s]; 0 where it may be."""
        return max(0.0, self._due - now)

    def failing_for(self, now: float) -> float:
        """Time for which it has been failing [s]; 0 where it does not."""
        return 0.0 if self.since is None else now - self.since
