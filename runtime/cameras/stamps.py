"""Capture times of pictures: the stream's time on our clock."""

from __future__ import annotations

import math

from runtime.core.clock import ClockMap


class StreamTime:
    """Map from one stream's stamps to our clock, by the smallest (arrival - stamp) over a window.

    A stamp that goes back begins a new map; a stamp that runs ahead is itself the smallest offset. `jumps` counts both.
    Returned times always increase, because pictures are distinguished by them.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._newest = -math.inf
        self._begin()

    def reset(self) -> None:
        """Begin a new map: a stream that was opened again starts with any stamp."""
        self._begin()

    def to_monotonic(self, stamp: float | None, arrived: float) -> float:
        """Return our time [s] for the stream's `stamp` [s], at most `arrived`; `arrived` itself without a stamp."""
        time = arrived if stamp is None else self._mapped(stamp, arrived)
        if time <= self._newest:
            time = math.nextafter(self._newest, math.inf)
        self._newest = time
        return time

    def _begin(self) -> None:
        self._map = ClockMap()

    def _mapped(self, stamp: float, arrived: float) -> float:
        before = self._map.restarts + self._map.leaps
        time = self._map.map(stamp, arrived)
        self.jumps += self._map.restarts + self._map.leaps - before
        return time
