"""ROS time on our clock: stamps are wall time, or a simulation's, and jump; ours never does."""

from __future__ import annotations

from collections import defaultdict

from runtime.core.clock import ClockMap, ClockStepDetector


class RosClock:
    """One map for all streams of a robot, so that each stream's own delay stays visible in its age.

    Every stream is watched for steps by itself, because a camera may be late by more than joints are. After a step
    nothing that was received before can be compared with what comes; the map starts anew.
    """

    def __init__(self) -> None:
        self._map = ClockMap()
        self._steps: defaultdict[str, ClockStepDetector] = defaultdict(ClockStepDetector)

    @property
    def backwards(self) -> int:
        """Count of times that the clock was set back."""
        return self._map.restarts

    @property
    def forwards(self) -> int:
        """Count of times that it was set ahead."""
        return self._map.leaps

    def to_monotonic(self, stream: str, stamp: float, arrival: float) -> float:
        """A stamp [s] in our clock, never later than its arrival; counts a step as one of those it has seen."""
        before = self._map.restarts + self._map.leaps
        time = self._map.map(stamp, arrival, self._steps[stream])
        if self._map.restarts + self._map.leaps > before:
            for name, steps in self._steps.items():
                if name != stream:
                    steps.reset()
        return time
