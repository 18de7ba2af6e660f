"""Clocks: the machine's monotonic clock, and the mapping of a peer's clock to it."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from typing import NamedTuple

_LEAP_S = 0.5  # [s] step ahead that no initial delay explains
_LEARNT, _ENOUGH = 32, 8  # intervals used to estimate period and jitter: at most, at least
_LEAST_S = 0.01  # [s] least jitter: smaller steps age nothing
_STEADY_S = 0.15  # [s] duration of constant lateness that indicates a clock step
_SILENCE_S = 1.0  # [s] gap after which the time of the next message is unknown
_UNDECIDED_S = 5.0  # [s] longest observation of a lateness that does not become constant
_SETTLED_S = 1.0  # [s] after the start: until then all messages may have been late


class Clock(ABC):
    """Source of time that never goes backwards [s]."""

    @abstractmethod
    def now(self) -> float:
        """Return the seconds since an arbitrary start."""

    @abstractmethod
    def sleep_until(self, deadline: float) -> None:
        """Return at `deadline` or just after it; immediately if it has passed."""


class MonotonicClock(Clock):
    """CLOCK_MONOTONIC of this machine, which all processes share."""

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        # time.sleep waits on CLOCK_MONOTONIC until an absolute deadline, through signals.
        remaining = deadline - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)


class VirtualClock(Clock):
    """Clock that moves only by `advance` and `sleep_until`; for lockstep and tests."""

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
    """Possible step of a peer's clock back, recognised by messages that are suddenly later than before.

    The candidate is a sequence of messages that are equally late, after a message that was less late.
    """

    first: float  # arrival of the first late message
    since: float  # arrival of the first of the equally late messages
    offset: float  # (arrival - stamp) of that message
    before: float  # (arrival - stamp) of the last message that was not late
    steady: float  # time for which they must stay equally late [s]


class ClockStepDetector:
    """Detector of steps of a peer's clock in one ordered stream of messages; it distinguishes steps from delays.

    A delayed message has a stamp on the stream's period, but arrives off the period. After a clock step the stamp is
    off the period, but the arrival is on it.

    A stamp more than `tolerance` [s] before an earlier one is a step back at once. A late message is only a candidate
    for a step back if its stamp is a little before the previous one, or is off the period while the arrival is on the
    period. It counts as a step back once all messages of the next 0.15 s are equally late; messages in a burst after a
    delay are not. After a gap of more than 1 s the period is unknown: every late message is a candidate, and all
    messages of the next 1 s must be equally late.

    A message with a smaller (arrival - stamp) than all before it is a step ahead, unless its arrival is off the period
    and the difference is at most 0.5 s. In the first second of a stream only a difference of more than 0.5 s counts.
    Differences within the jitter are ignored.
    """

    def __init__(self, tolerance: float = 0.5) -> None:
        self._tolerance = tolerance
        self._intervals: deque[float] = deque(maxlen=_LEARNT)  # of stamps [s]
        self._noise: deque[float] = deque(maxlen=_LEARNT)  # |arrival interval - stamp interval| [s]
        self.reset()

    def reset(self) -> None:
        """Discard the last message; the estimates of period and jitter are kept."""
        self._newest = -math.inf
        self._began = math.inf
        self._last: tuple[float, float] | None = None  # stamp, arrival
        self._suspect: _StepCandidate | None = None

    def update(self, stamp: float, arrival: float, least: float) -> float:
        """Return the clock step detected with this message [s], negative if set back; 0.0 if there is none.

        `least` is the smallest (arrival - stamp) over all streams of the peer.
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
            self._suspect = None  # a delay that is over, or an undecidable case
        elif abs(offset - suspect.offset) > self._jitter():
            self._suspect = suspect._replace(since=arrival, offset=offset)
        elif arrival - suspect.since >= suspect.steady:
            return self._set(suspect.before - offset)
        return 0.0

    def _jitter(self) -> float:
        """Return the jitter of intervals [s]; inf while too few are known."""
        if len(self._noise) < _ENOUGH:
            return math.inf
        return max(_LEAST_S, 3.0 * sorted(self._noise)[len(self._noise) * 9 // 10])

    def _off_more(self, moved: float, waited: float) -> float:
        """Return by how much more the stamp is out of the stream's period than the arrival [s].

        Each of the two intervals is compared with the nearest multiple of the period: `moved` is the interval since the
        previous stamp, `waited` the interval since the previous arrival [s]. The result is the distance of `moved`
        minus the distance of `waited`.
        """
        period = max(sorted(self._intervals)[len(self._intervals) // 2], _LEAST_S / 10)
        return _off(moved, period) - _off(waited, period)


def _off(interval: float, period: float) -> float:
    """Return the distance [s] of an interval from the nearest positive multiple of the period."""
    return abs(interval - max(1, round(interval / period)) * period)


class ClockMap:
    """Mapping of a peer's clock to ours by the smallest (arrival - stamp) of the last `window` seconds.

    Clocks drift by tens of ppm, hence a window and not the minimum of all times. After a step or restart of the
    peer's clock the mapping starts anew: `restarts` counts steps back, `leaps` steps ahead. If a peer has several
    streams, each needs its own ClockStepDetector. Source: the minimum filter of NTP (RFC 5905, section 10).
    """

    def __init__(self, window: float = 45.0, tolerance: float = 0.5) -> None:
        self._window = window
        self._steps = ClockStepDetector(tolerance)
        self._minima: deque[tuple[float, float]] = deque()  # (arrival, offset), offsets increasing
        self.restarts = 0
        self.leaps = 0

    def map(self, stamp: float, arrival: float, steps: ClockStepDetector | None = None) -> float:
        """Return the peer's `stamp` on our clock, never later than `arrival`.

        `steps` detects steps of the peer's clock in the stream that the stamp belongs to; None selects the detector of
        this map.
        """
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
        return min(arrival, stamp + self._minima[0][1])  # rounding could make it later than the arrival
