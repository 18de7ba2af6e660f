"""Brings streams of stamped messages together at one moment; knows nothing of what they carry."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

Value = TypeVar("Value")
DEPTH = 2000  # samples: two seconds of a stream at 1 kHz


@dataclass(frozen=True, slots=True)
class Sample(Generic[Value]):
    """One message of a stream: `stamp` in the sender's clock, `arrived` in ours [s]."""

    stamp: float
    arrived: float
    value: Value


@dataclass(frozen=True, slots=True)
class Aligned(Generic[Value]):
    """One sample of every stream, each within the window around `time`, in the senders' clock [s]."""

    time: float
    samples: Mapping[str, Sample[Value]]


class Alignment(Generic[Value]):
    """The newest messages of every stream; who reads takes nothing away, so there may be many readers.

    The moment of a frame is the newest that all streams have reached: the smallest of their newest stamps. Of
    each stream the sample nearest to it counts, and where the nearest of one is further away than `window` [s]
    there is no frame: a reader waits rather than being given what does not belong together.

    A stream keeps what is at most `history` [s] older than its newest sample, and at most as many as `depths` says,
    or DEPTH, so that a stream that stalls makes no other one grow.
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
        """Take a sample; False for one that is not newer than the newest of its stream, which is left out."""
        kept = self._samples[stream]
        if kept and sample.stamp <= kept[-1].stamp:
            return False
        kept.append(sample)
        while kept[0].stamp < sample.stamp - self._history:
            kept.popleft()
        return True

    def newest(self, stream: str) -> Sample[Value] | None:
        """The newest sample of a stream."""
        kept = self._samples[stream]
        return kept[-1] if kept else None

    def clear(self) -> None:
        """Forget everything: the senders' clock has been set."""
        for kept in self._samples.values():
            kept.clear()

    def newest_common_time(self) -> float | None:
        """The newest moment that all streams have reached; None while one has sent nothing."""
        if not all(self._samples.values()):
            return None
        return min(kept[-1].stamp for kept in self._samples.values())

    def frame(self, after: Aligned[Value] | None = None) -> Aligned[Value] | None:
        """The newest frame if it is later than `after`, the reader's last one, and has a sample that is not in that."""
        time = self.newest_common_time()
        if time is None or (after is not None and time <= after.time):
            return None
        chosen = {name: _nearest(kept, time) for name, kept in self._samples.items()}
        if any(abs(sample.stamp - time) > self._window for sample in chosen.values()):
            return None
        if after is not None and all(sample is after.samples[name] for name, sample in chosen.items()):
            return None
        return Aligned(time, chosen)

    def unaligned_streams(self) -> list[str]:
        """The streams that have no sample near enough to the moment that all have reached."""
        time = self.newest_common_time()
        if time is None:
            return []
        return [
            name
            for name, kept in self._samples.items()
            if abs(_nearest(kept, time).stamp - time) > self._window
        ]


def _nearest(kept: deque[Sample[Value]], time: float) -> Sample[Value]:
    """The sample nearest to `time`, the older one of two; the newest ones are looked at first."""
    best = kept[-1]
    for sample in reversed(kept):
        if abs(sample.stamp - time) > abs(best.stamp - time):
            break
        best = sample
    return best
