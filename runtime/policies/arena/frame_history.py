"""History of pictures before a request, at the steps that a policy was trained with."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping

from runtime.core.types import Observation, UInt8

_ROOM = 8.0  # spare steps before the oldest one used, because a request may be about an older observation

Pictures = Mapping[str, UInt8]


class History:
    """Pictures of the newest observations, for requests that also contain earlier pictures.

    `steps` are the numbers of steps before the request at which pictures are sent; `rate` is the number of steps per
    second. One thread, which queries the policy, reads it; other threads may add observations.
    """

    def __init__(self, steps: tuple[int, ...], rate: float) -> None:
        self._steps, self._rate = steps, rate
        self._kept: deque[tuple[float, Pictures]] = deque()
        self._lock = threading.Lock()

    def add(self, observation: Observation) -> None:
        """Add an observation's pictures, unless a stored observation arrived at the same time or later."""
        with self._lock:
            if self._kept and observation.arrived <= self._kept[-1][0]:
                return
            self._kept.append((observation.arrived, observation.pictures))
            oldest = observation.arrived - (max(self._steps) + _ROOM) / self._rate
            while self._kept[0][0] < oldest:
                self._kept.popleft()

    def frames_before(self, observation: Observation) -> list[Pictures]:
        """Return for each of `steps` before `observation` the pictures nearest to it in time, in the order of `steps`.

        Pictures that arrived after `observation` are never returned. For steps before the oldest stored observation the
        pictures of the oldest are returned. `observation` itself is added to the history.
        """
        self.add(observation)
        with self._lock:
            stored = [frame for frame in self._kept if frame[0] < observation.arrived]
        stored.append((observation.arrived, observation.pictures))
        moments = (observation.arrived - step / self._rate for step in self._steps)
        return [min(stored, key=lambda frame: abs(frame[0] - moment))[1] for moment in moments]

    def reset(self) -> None:
        """Drop all pictures."""
        with self._lock:
            self._kept.clear()
