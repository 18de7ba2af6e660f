"""Time: one monotonic clock for everything we stamp, and a map from a peer's clock onto it."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from typing import NamedTuple

_LEAP_S = 0.5  # more than a first message can have been late by
_LEARNT, _ENOUGH = (
    32,
    8,
)  # intervals of a stream that its period and jitter are taken from, and from how many on
_LEAST_S = 0.01  # of a step: less ages nothing
_STEADY_S = 0.15  # how long all that comes has to be equally late, so that it is the clock
_SILENCE_S = 1.0  # after which nothing is known of when the next message was due
_UNDECIDED_S = 5.0  # how long lateness that is never steady is looked at
_SETTLED_S = 1.0  # until then what comes first may all have been late


class Clock(ABC):
    """Seconds that never go backwards."""

    @abstractmethod
    def now(self) -> float:
        """Seconds since an arbitrary start."""

    @abstractmethod
    def sleep_until(self, deadline: float) -> None:
        """Return at `deadline` or just after it; at once where it has passed."""


class MonotonicClock(Clock):
    """CLOCK_MONOTONIC of this machine, shared by all of its processes."""

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        # time.sleep itself waits on CLOCK_MONOTONIC, to an absolute deadline, through signals.
        remaining = deadline - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)


class VirtualClock(Clock):
    """A clock that moves only when told; used by lockstep and by tests."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep_until(self, deadline: float) -> None:
        self._now = max(self._now, deadline)

    def advance(self, seconds: float) -> None:
        if not seconds >= 0:
            raise ValueError(f"advance by {seconds!r} s: time does not go backwards; allowed: 0 or more")
        self._now += seconds


class _StepCandidate(NamedTuple):
    """Messages that are as late as each other, and later than one before them."""

    first: float  # arrival of the first that was late at all
    since: float  # arrival of the first of those that are equally late
    offset: float  # (arrival - stamp) of that one
    before: float  # the same of the last that was not late
    steady: float  # for how long they have to be so [s]


class ClockStepDetector:
    """Tells steps of a peer's clock from delays, by the messages of one stream, which come in their order.

    A delay leaves stamps where the stream's period puts them, and moves arrivals; a step does the opposite. A stamp
    more than `tolerance` before an earlier one is a step back at once. A lesser one is, or one that is off the period
    where its arrival is not, when all that has followed for 0.15 s is equally late: a burst is not. After a silence, in
    which nothing is known of periods, that takes 1 s. A message earlier than any before is a step ahead, unless it is
    its arrival that is off the period. What is within the jitter is neither.
    """

    def __init__(self, tolerance: float = 0.5) -> None:
        self._tolerance = tolerance
        self._intervals: deque[float] = deque(maxlen=_LEARNT)  # of stamps [s]
        self._noise: deque[float] = deque(maxlen=_LEARNT)  # by how much those of arrivals differed [s]
        self.reset()

    def reset(self) -> None:
        """Compare what comes with nothing before it; period and jitter stay known."""
        self._newest = -math.inf
        self._began = math.inf
        self._last: tuple[float, float] | None = None  # stamp, arrival
        self._suspect: _StepCandidate | None = None

    def update(self, stamp: float, arrival: float, least: float) -> float:
        """By how much the clock was set [s], < 0 back, as found with this message; 0.0 where it was not.

        `least` is the least (arrival - stamp) of all streams of the peer.
        """
        last, self._last = self._last, (stamp, arrival)
        newest, self._newest = self._newest, max(self._newest, stamp)
        if last is None:
            self._began = arrival
            return 0.0
        if stamp < newest - self._tolerance:
            return self._set(stamp - newest)
        moved, waited, offset = stamp - last[0], arrival - last[1], arrival - stamp
        if self._is_ahead(least - offset, moved, waited, arrival):
            return self._set(least - offset)
        if self._suspect is not None:
            return self._judge(self._suspect, offset, arrival)
        if self._may_be_back(moved, waited):
            steady = _STEADY_S if waited < _SILENCE_S else _SILENCE_S
            self._suspect = _StepCandidate(arrival, arrival, offset, last[1] - last[0], steady)
        else:
            self._intervals.append(moved)
            self._noise.append(abs(waited - moved))
        return 0.0

    def _set(self, step: float) -> float:
        assert self._last is not None
        (self._newest, self._began), self._suspect = self._last, None
        return step

    def _is_ahead(self, by: float, moved: float, waited: float, arrival: float) -> bool:
        if by <= _LEAP_S and (by <= self._jitter() or arrival - self._began < _SETTLED_S):
            return False
        return by > _LEAP_S or self._off_more(moved, waited) > -self._jitter()

    def _may_be_back(self, moved: float, waited: float) -> bool:
        jitter = self._jitter()
        if waited - moved <= jitter:
            return False
        return moved < 0.0 or waited > _SILENCE_S or self._off_more(moved, waited) > jitter

    def _judge(self, suspect: _StepCandidate, offset: float, arrival: float) -> float:
        if offset - suspect.before <= self._jitter() or arrival - suspect.first > _UNDECIDED_S:
            self._suspect = None  # a delay, and it is over; or neither is to be had
        elif abs(offset - suspect.offset) > self._jitter():
            self._suspect = suspect._replace(since=arrival, offset=offset)
        elif arrival - suspect.since >= suspect.steady:
            return self._set(suspect.before - offset)
        return 0.0

    def _jitter(self) -> float:
        """Jitter of intervals without a step [s]; inf while too little is known."""
        if len(self._noise) < _ENOUGH:
            return math.inf
        return max(_LEAST_S, 3.0 * sorted(self._noise)[len(self._noise) * 9 // 10])

    def _off_more(self, moved: float, waited: float) -> float:
        """Excess of the stamp's distance from the stream's period over that of the arrival [s]."""
        period = max(sorted(self._intervals)[len(self._intervals) // 2], _LEAST_S / 10)
        return _off(moved, period) - _off(waited, period)


def _off(interval: float, period: float) -> float:
    """Distance of an interval from one or more whole periods [s]."""
    return abs(interval - max(1, round(interval / period)) * period)


class ClockMap:
    """Maps a peer's clock onto ours by the smallest (arrival - stamp) of the last `window` seconds.

    Clocks drift by tens of ppm, so the minimum is taken over a window and not for ever. Where `steps` tells that the
    peer's clock was set, or that it was started anew, the map starts anew: `restarts` counts steps back, `leaps` those
    ahead. Several streams of one peer have steps each.
    Source: the minimum filter of NTP (RFC 5905, section 10).
    """

    def __init__(self, window: float = 45.0, tolerance: float = 0.5) -> None:
        self._window = window
        self._steps = ClockStepDetector(tolerance)
        self._minima: deque[tuple[float, float]] = deque()  # (arrival, offset), offsets increasing
        self.restarts = 0
        self.leaps = 0

    def map(self, stamp: float, arrival: float, steps: ClockStepDetector | None = None) -> float:
        """The peer's `stamp` in our clock; never later than `arrival`. `steps` are those of the stamp's own stream."""
        offset = arrival - stamp
        least = self._minima[0][1] if self._minima else math.inf
        step = (steps or self._steps).update(stamp, arrival, least)
        if step:
            self._minima.clear()
            self.restarts += step < 0
            self.leaps += step > 0
        while self._minima and self._minima[-1][1] >= offset:
            self._minima.pop()
        self._minima.append((arrival, offset))
        while self._minima[0][0] < arrival - self._window:
            self._minima.popleft()
        return min(arrival, stamp + self._minima[0][1])  # rounding may put it a hair later
