"""Times of an episode as Unix nanoseconds, in order."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.core.errors import RecordingError
from runtime.interop.ros2_messages import SECOND
from runtime.recording.reader import Episode

_END = 2**31 * SECOND  # first stamp that does not fit into ROS's seconds [ns]

Seconds = NDArray[np.float64]
Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Ordered:
    """Stamps that do not fall [ns], and the number of those that had to be moved for it."""

    stamps: Stamps
    moved: int


class EpisodeTimes:
    """Clock of an episode: seconds since its start to Unix nanoseconds, and steps to seconds.

    Raises RecordingError if the manifest does not say when the episode began.
    """

    def __init__(self, episode: Episode) -> None:
        wall = episode.manifest.get("started_wall")
        if isinstance(wall, bool) or not isinstance(wall, (int, float)) or not math.isfinite(wall):
            raise _wrong_start(wall)
        self.start = round(wall * SECOND)
        if not 0 <= self.start < _END:
            raise _wrong_start(wall)
        rate = episode.manifest.get("control_rate")
        is_rate = isinstance(rate, (int, float)) and math.isfinite(rate) and rate > 0
        self._rate = float(rate) if is_rate else episode.layout.fps  # type: ignore[arg-type]
        table, times = (episode.ticks, "planned") if episode.ticks.num_rows else (episode.rows, "tick_time")
        self._steps = np.asarray(table["step"].to_numpy(), np.int64)
        self._planned = seconds(table[times])

    def at_steps(self, steps: NDArray[np.int64]) -> Seconds:
        """Return the planned times of control steps [s since the start].

        A step without a tick has the time of the tick before it, and the periods in between.
        """
        if not len(self._steps):
            return np.asarray(steps / self._rate, np.float64)
        places = np.maximum(np.searchsorted(self._steps, steps, side="right") - 1, 0)
        return np.asarray(self._planned[places] + (steps - self._steps[places]) / self._rate, np.float64)

    def ordered(self, times: Seconds, instead: Seconds | None = None, *, apart: bool = False) -> Ordered:
        """Return times [s since the start] as Unix nanoseconds that do not fall; with `apart` they rise.

        A time that is not known is that of `instead`, if it is known there, else the one before. A time earlier than
        the one before is moved to that.
        """
        stamps: list[int] = []
        moved, before = 0, -1
        others = times if instead is None else instead
        for time, other in zip(times.tolist(), others.tolist(), strict=True):
            stamp = self._stamp(time)
            stamp = self._stamp(other) if stamp is None else stamp
            least = before + 1 if apart else before
            moved += stamp is not None and stamp < least
            if stamp is None:
                stamp = before if stamps else self.start
            before = max(stamp, least)
            stamps.append(before)
        return Ordered(np.array(stamps, np.int64), moved)

    def _stamp(self, time: float) -> int | None:
        if not math.isfinite(time):
            return None
        stamp = self.start + round(time * SECOND)
        return stamp if 0 <= stamp < _END else None


def seconds(column: Any) -> Seconds:
    """Return a column of times as float64 [N], NaN where it is null."""
    return np.array([math.nan if time is None else time for time in column.to_pylist()], np.float64)


def _wrong_start(wall: object) -> RecordingError:
    return RecordingError(
        f"manifest: started_wall is {wall!r}, must be Unix time in seconds, from 0 to 2**31"
    )
