"""Exponential back-off between attempts."""

from __future__ import annotations

_FIRST_S, _LONGEST_S = 0.1, 2.0


class BackOff:
    """Exponential back-off: each failure doubles the delay, a success (`reset`) clears it.

    Times are on the caller's clock [s].
    """

    def __init__(self, first: float = _FIRST_S, longest: float = _LONGEST_S) -> None:
        self._first, self._longest = first, longest
        self.reset()

    def reset(self) -> None:
        """Clear all failures."""
        self._failures = 0
        self._due = float("-inf")
        self.since: float | None = None  # time of the first of the consecutive failures

    def record_failure(self, now: float) -> None:
        """Record a failure at `now` and postpone the next attempt."""
        self.since = now if self.since is None else self.since
        self._due = now + min(self._longest, self._first * 2.0 ** min(self._failures, 32))
        self._failures += 1

    def remaining_delay(self, now: float) -> float:
        """Return the time until the next attempt is due [s]; 0 if it is due now."""
        return max(0.0, self._due - now)

    def failing_for(self, now: float) -> float:
        """Return the time since the first of the consecutive failures [s]; 0 if there is none."""
        return 0.0 if self.since is None else now - self.since
