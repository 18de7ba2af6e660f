"""Alignment of streams of stamped messages in time, independent of their content."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from runtime.core.clock import ClockMap, ClockStepDetector


class RosClock:
    """Clock map shared by all streams of a robot, so that a stream's own delay remains part of its age.

    Steps of the senders' clock are detected separately for each stream: with a common detector, a camera that is much
    later than the joints would look like a step. After a step, earlier stamps cannot be compared with later stamps, and
    the map starts anew.
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
        """Return a stamp [s] on our clock, never later than its arrival; a detected clock step is counted."""
        before = self._map.restarts + self._map.leaps
        time = self._map.map(stamp, arrival, self._steps[stream])
        if self._map.restarts + self._map.leaps > before:
            # The shared map has started anew: old offsets of the other streams would count as further steps.
            for name, steps in self._steps.items():
                if name != stream:
                    steps.reset()
        return time


Value = TypeVar("Value")
DEPTH = 2000  # [samples]; two seconds of a stream at 1 kHz


@dataclass(frozen=True, slots=True)
class Sample(Generic[Value]):
    """One message of a stream: `stamp` in the sender's clock, `arrived` in ours [s]."""

    stamp: float
    arrived: float
    value: Value


@dataclass(frozen=True, slots=True)
class Aligned(Generic[Value]):
    """Frame: one sample of every stream, each within the window around `time` (in the senders' clock [s])."""

    time: float
    samples: Mapping[str, Sample[Value]]


class Alignment(Generic[Value]):
    """Newest messages of every stream, aligned on request. Reading removes nothing, so there may be many readers.

    The time of a frame is the newest that all streams have reached: the smallest of their newest stamps. Each stream
    contributes its sample nearest to that time. If such a sample is further away than `window` [s], there is no frame:
    a reader then waits and does not receive samples of different times.

    A stream drops samples more than `history` [s] older than its newest, and keeps at most `depths[name]` (default
    DEPTH) samples, so that one stalled stream does not let the others grow.
    """

    def __init__(
        self,
        streams: Sequence[str],
        window: float,
        history: float = 1.0,
        depths: Mapping[str, int] | None = None,
    ) -> None:
        self._window = window
        self._history = history
        depth = depths or {}
        self._samples: dict[str, deque[Sample[Value]]] = {
            name: deque(maxlen=depth.get(name, DEPTH)) for name in streams
        }

    def add(self, stream: str, sample: Sample[Value]) -> bool:
        """Add a sample; return False, without adding it, if it is not newer than the newest of its stream."""
        samples = self._samples[stream]
        if samples and sample.stamp <= samples[-1].stamp:
            return False
        samples.append(sample)
        while samples[0].stamp < sample.stamp - self._history:
            samples.popleft()
        return True

    def newest(self, stream: str) -> Sample[Value] | None:
        """Return the newest sample of a stream, or None."""
        samples = self._samples[stream]
        return samples[-1] if samples else None

    def clear(self) -> None:
        """Drop all samples, because the senders' clock has been set."""
        for samples in self._samples.values():
            samples.clear()

    def newest_common_time(self) -> float | None:
        """Return the newest time that all streams have reached; None while one of them has no sample."""
        if not all(self._samples.values()):
            return None
        return min(samples[-1].stamp for samples in self._samples.values())

    def frame(self, after: Aligned[Value] | None = None) -> Aligned[Value] | None:
        """Return the newest frame, or None if there is none that is newer than `after`, the last frame of this reader.

        A frame is newer if its time is later and at least one of its samples is not in `after`.
        """
        time = self.newest_common_time()
        if time is None or (after is not None and time <= after.time):
            return None
        chosen = {name: _nearest(samples, time) for name, samples in self._samples.items()}
        if any(abs(sample.stamp - time) > self._window for sample in chosen.values()):
            return None
        if after is not None and all(sample is after.samples[name] for name, sample in chosen.items()):
            return None
        return Aligned(time, chosen)

    def unaligned_streams(self) -> list[str]:
        """Return the streams without a sample within the window around the newest common time."""
        time = self.newest_common_time()
        if time is None:
            return []
        return [
            name
            for name, samples in self._samples.items()
            if abs(_nearest(samples, time).stamp - time) > self._window
        ]


def _nearest(samples: deque[Sample[Value]], time: float) -> Sample[Value]:
    """Return the sample nearest to `time`, the older of two at the same distance.

    The search starts from the newest sample.
    """
    # Stamps increase, so after the first sample that is further away all older ones are, too.
    best = samples[-1]
    for sample in reversed(samples):
        if abs(sample.stamp - time) > abs(best.stamp - time):
            break
        best = sample
    return best
