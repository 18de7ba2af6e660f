"""ROS time on our clock: stamps are wall time, or a simulation's, and jump; ours never does."""

from __future__ import annotations

from runtime.clock import ClockMap

JUMP_S = 0.5  # a stamp that is further off than this from where its stream's clock should be is a jump


class RosClock:
    """One map for all streams of a robot, so that each stream's own delay stays visible in its age.

    Every stream is watched for jumps by itself, because a camera may be late by more than joints are. After a jump
    back nothing that was received before can be compared with what comes; the map starts anew.
    """

    def __init__(self) -> None:
        self._map = _map()
        self._newest: dict[str, tuple[float, float]] = {}  # by stream: stamp, arrival
        self.backwards = 0
        self.forwards = 0

    def see(self, stream: str, stamp: float, arrival: float) -> float:
        """A stamp [s] in our clock, never later than its arrival; counts a jump as one of those it has seen."""
        before = self._newest.get(stream)
        if before is not None and stamp < before[0] - JUMP_S:
            self.backwards += 1
            self._map = _map()
            self._newest.clear()
        elif before is not None and stamp - before[0] > arrival - before[1] + JUMP_S:
            self.forwards += 1
        known = self._newest.get(stream)
        if known is None or stamp > known[0]:
            self._newest[stream] = (stamp, arrival)
        return self._map.map(stamp, arrival)


def _map() -> ClockMap:
    return ClockMap(tolerance=float("inf"))  # jumps are noticed stream by stream
