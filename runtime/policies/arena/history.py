"""History before a request: pictures of some moments before it, those that a policy was trained to see."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping

from runtime.core.types import Observation, UInt8

_ROOM = 8.0  # steps beyond the oldest that is shown: a request is about an observation that is not the newest any more

Pictures = Mapping[str, UInt8]


class History:
    """Keeps the newest observations' pictures as they came; `steps` before a request are `rate` to a second.

    It is looked at from the thread that asks the policy, and filled from another as well.
    """

    def __init__(self, steps: tuple[int, ...], rate: float) -> None:
        self._steps, self._rate = steps, rate
        self._kept: deque[tuple[float, Pictures]] = deque()
        self._lock = threading.Lock()

    def add(self, observation: Observation) -> None:
        """Keep its pictures; one that is no newer than the newest is kept already, or too late."""
        with self._lock:
            if self._kept and observation.arrived <= self._kept[-1][0]:
                return
            self._kept.append((observation.arrived, observation.pictures))
            oldest = observation.arrived - (max(self._steps) + _ROOM) / self._rate
            while self._kept[0][0] < oldest:
                self._kept.popleft()

    def frames_before(self, observation: Observation) -> list[Pictures]:
        """Pictures nearest to each of the steps before `observation`, in their order; never of after it.

        Where nothing as old was seen, the oldest; the observation is kept like any other.
        """
        self.add(observation)
        with self._lock:
            seen = [one for one in self._kept if one[0] < observation.arrived]
        seen.append((observation.arrived, observation.pictures))
        moments = (observation.arrived - step / self._rate for step in self._steps)
        return [min(seen, key=lambda one: abs(one[0] - moment))[1] for moment in moments]

    def reset(self) -> None:
        """Nothing was seen yet."""
        with self._lock:
            self._kept.clear()
