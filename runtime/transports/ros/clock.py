"""Mapping of ROS time to our monotonic clock: stamps are wall or simulated time and may jump; ours never does."""

from __future__ import annotations

from collections import defaultdict

from runtime.core.clock import ClockMap, ClockStepDetector


class RosClock:
    """Clock map shared by all streams of a robot, so that each stream's own delay stays visible in its age.

    Clock steps are detected per stream, because a camera may be later than joints by more than a step. After a step,
    earlier stamps cannot be compared with later stamps, and the map starts anew.
    """

    def __init__(self) -> None:
        self._map = ClockMap()
        self._steps: defaultdict[str, ClockStepDetector] = defaultdict(ClockStepDetector)

    @property
    def backwards(self) -> int:
        """Number of times that the clock was set back."""
        return self._map.restarts

    @property
    def forwards(self) -> int:
        """Number of times that the clock was set forward."""
        return self._map.leaps

    def to_monotonic(self, stream: str, stamp: float, arrival: float) -> float:
        """Return a stamp [s] in our clock, never later than its arrival. A detected step is counted."""
        before = self._map.restarts + self._map.leaps
        time = self._map.map(stamp, arrival, self._steps[stream])
        if self._map.restarts + self._map.leaps > before:
            # The shared map has started anew: old offsets of the other streams would count as further steps.
            for name, steps in self._steps.items():
                if name != stream:
                    steps.reset()
        return time
