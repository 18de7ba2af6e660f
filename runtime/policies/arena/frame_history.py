"""History of pictures before a request, at the moments that a policy was trained with."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping

from runtime.core.types import Observation, UInt8

_ROOM = 8.0  # spare steps before the oldest one used, because a request may be about an older observation

Pictures = Mapping[str, UInt8]


class History:
    """Pictures of the newest observations; `rate` steps before a request are one second.

    Read by the thread that queries the policy, and filled by other threads as well.
    """

    def __init__(self, steps: tuple[int, ...], rate: float) -> None:
        self._steps, self._rate = steps, rate
        self._kept: deque[tuple[float, Pictures]] = deque()
        self._lock = threading.Lock()

    def add(self, observation: Observation) -> None:
        """Add an observation's pictures, unless it is no newer than the newest one."""
        with self._lock:
            if self._kept and observation.arrived <= self._kept[-1][0]:
                return
            self._kept.append((observation.arrived, observation.pictures))
            oldest = observation.arrived - (max(self._steps) + _ROOM) / self._rate
            while self._kept[0][0] < oldest:
                self._kept.popleft()

    def frames_before(self, observation: Observation) -> list[Pictures]:
        """Return the pictures nearest to each of the steps before `observation`, in their order.

        Pictures of a later moment are never returned; steps before the oldest observation yield the oldest. The
        observation itself is added like any other.
        """
        self.add(observation)
        with self._lock:
            seen = [one for one in self._kept if one[0] < observation.arrived]
        seen.append((observation.arrived, observation.pictures))
        moments = (observation.arrived - step / self._rate for step in self._steps)
        return [min(seen, key=lambda one: abs(one[0] - moment))[1] for moment in moments]

    def reset(self) -> None:
        """Drop all pictures."""
        with self._lock:
            self._kept.clear()
