"""When a picture was taken: the stream's time on our clock."""

from __future__ import annotations

import math

from runtime.core.clock import ClockMap


class StreamTime:
    """Maps the stamps of one stream by the smallest (arrival - stamp) over a window; `jumps` counts where it broke.

    A stamp that goes back begins a new map; one that is further ahead than time has passed is the smallest offset
    by itself. What is returned always increases: pictures are told apart by it.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._newest = -math.inf
        self._begin()

    def reset(self) -> None:
        """The stream was opened anew: its stamps begin anywhere."""
        self._begin()

    def to_monotonic(self, stamp: float | None, arrived: float) -> float:
        """Our time [s] for the stream's `stamp` [s], never after `arrived`; `arrived` where there is no stamp."""
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
