"""When a picture was taken: the stream's time on our clock."""

from __future__ import annotations

import math

from runtime.clock import ClockMap

JUMP_S = 0.5  # more than this is no jitter


class StreamTime:
    """Maps the stamps of one stream by the smallest (arrival - stamp) over a window; `jumps` counts where it broke.

    A stamp that goes back begins a new map; one that is further ahead than time has passed is the smallest offset
    by itself. What is returned always increases: pictures are told apart by it.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._newest = -math.inf
        self._begin()

    def begin(self) -> None:
        """The stream was opened anew: its stamps begin anywhere."""
        self._begin()

    def captured(self, stamp: float | None, arrived: float) -> float:
        """Our time [s] for the stream's `stamp` [s], never after `arrived`; `arrived` where there is no stamp."""
        time = arrived if stamp is None else self._mapped(stamp, arrived)
        if time <= self._newest:
            time = math.nextafter(self._newest, math.inf)
        self._newest = time
        return time

    def _begin(self) -> None:
        self._map = ClockMap(tolerance=JUMP_S)
        self._before: tuple[float, float] | None = None  # stamp, arrival

    def _mapped(self, stamp: float, arrived: float) -> float:
        if self._before is not None:
            ahead = (stamp - self._before[0]) - (arrived - self._before[1])
            self.jumps += ahead > JUMP_S or stamp < self._before[0] - JUMP_S
        self._before = (stamp, arrived)
        return self._map.map(stamp, arrived)
