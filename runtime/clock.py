"""Time: one monotonic clock for everything we stamp, and a map from a peer's clock onto it."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque

_LEAP_S = 0.5  # more than a first message can have been late by


class Clock(ABC):
    """Seconds that never go backwards."""

    @abstractmethod
    def now(self) -> float:
        """Seconds since an arbitrary start."""

    @abstractmethod
    def sleep_until(self, deadline: float) -> None:
        """Return at `deadline` or just after it; at once where it has passed."""


class MonotonicClock(Clock):
    """CLOCK_MONOTONIC of this machine, shared by all of its processes."""

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        # time.sleep itself waits on CLOCK_MONOTONIC, to an absolute deadline, through signals.
        remaining = deadline - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)


class VirtualClock(Clock):
    """A clock that moves only when told; used by lockstep and by tests."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep_until(self, deadline: float) -> None:
        self._now = max(self._now, deadline)

    def advance(self, seconds: float) -> None:
        if not seconds >= 0:
            raise ValueError(f"advance by {seconds!r} s: time does not go backwards; allowed: 0 or more")
        self._now += seconds


class ClockMap:
    """Maps a peer's clock onto ours by the smallest (arrival - stamp) of the last `window` seconds.

    Clocks drift by tens of ppm, so the minimum is taken over a window and not for ever. A stamp that goes
    backwards by more than `tolerance` seconds means that the peer restarted, or that its clock was set back: the
    map starts anew and `restarts` counts it. A message that is half a second earlier than any before it means that
    the peer's clock leapt ahead: it becomes the smallest by itself and `leaps` counts it.
    Source: the minimum filter of NTP (RFC 5905, section 10).
    """

    def __init__(self, window: float = 45.0, tolerance: float = 0.5) -> None:
        self._window = window
        self._tolerance = tolerance
        self._minima: deque[tuple[float, float]] = deque()  # (arrival, offset), offsets increasing
        self._newest = float("-inf")
        self.restarts = 0
        self.leaps = 0

    def map(self, stamp: float, arrival: float) -> float:
        """The peer's `stamp` in our clock; never later than `arrival`."""
        if stamp < self._newest - self._tolerance:
            self._minima.clear()
            self._newest = stamp
            self.restarts += 1
        self._newest = max(self._newest, stamp)
        offset = arrival - stamp
        if self._minima and offset < self._minima[0][1] - _LEAP_S:
            self.leaps += 1
        while self._minima and self._minima[-1][1] >= offset:
            self._minima.pop()
        self._minima.append((arrival, offset))
        while self._minima[0][0] < arrival - self._window:
            self._minima.popleft()
        return min(arrival, stamp + self._minima[0][1])  # rounding may put it a hair later
