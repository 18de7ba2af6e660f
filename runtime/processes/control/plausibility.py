"""Plausibility of joint measurements: one bad sample must move no robot."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.ipc.observation_reader import LatestObservation
from runtime.motion.timeline import DimensionKinds, difference
from runtime.safety.limits import Limits

_BEYOND_LIMITS = Pattern(
    "control.beyond_limits",
    "{joint} reads {value:.3f} rad, beyond its limits {lower:.3f}..{upper:.3f}",
)
_NOT_SEEN_LONG_ENOUGH = Pattern(
    "control.not_seen_long_enough",
    "joints have not been seen for {seconds:g} s yet",
)
_TOO_FAST = Pattern(
    "control.too_fast",
    "{joint} reads {value:.3f} rad, {before:.3f} just before: faster than it moves ({speed:.2f} rad/s)",
)
_EXCHANGED = Pattern("control.exchanged", "{joints} read each other's values: are they swapped?")
_ENCODER_DEAD = Pattern("control.encoder_dead", "{what}: is an encoder dead?")
_STUCK = Pattern("control.stuck", "{joint} jumped to {value:.3f} rad and reads exactly that: is it stuck?")
_ZERO_AFTER = Pattern("control.zero_after", "{joints} read exactly 0 rad after {before}")
_UNMOVED = Pattern(
    "control.unmoved",
    "{joint} has read exactly {value:.4f} rad for {seconds:.1f} s while its command moved {distance:.2f} rad",
)

UNSEEN_S = 0.5  # without joints: whatever has happened to the robot meanwhile was not seen
CONSISTENT_S = 0.1  # that samples agree for before they are believed against what was known
_CONSISTENT = 3  # samples, at least, in that time
_EXCESS = 2.0  # times its velocity that a joint may be pushed at by hand
_NOISE = 0.02  # [rad] and [s] by which a sample and its stamp may be off
_LONGEST_S = 0.05  # without a sample, after which no longer way is believed at once
_STALL_S = 0.1  # between two looks of ours: it says nothing about the joints
_BEYOND = 0.1  # [rad] that an arm may rest beyond its limits
_FROZEN_S, _FROZEN_RAD = 1.0, 0.05
_LATENCY_S = 0.3  # a robot that stood may take this long to move after its command did
_TURNS = 3  # times that the last digits of an encoder which is never still went there and back
_STILL = 5  # samples that are equal, of one that is
_DIGITS = 1e-3  # [rad] that the last digits of an encoder are worth at most
_LEAP = 0.1  # [rad] between two samples, from which no joint comes to rest within the next one
_HARDEST = 100.0  # [rad/s2] that no joint accelerates at
_SAME = 0.02  # [rad] within which two joints have exchanged their values
_LONGEST_DOUBT_S = 2.0
_KEPT = 512  # samples: as many that agree are enough, however short their time at a high rate
_QUIET_S = 1.0  # without a contradiction, after which the next one is a first one
_GAP_S = 0.15  # between two samples, in which an arm that moves has gone somewhere else
_EPSILON = 1e-6  # stamps are sums of floats


class _Sample(NamedTuple):
    joints: Float64  # [D]
    captured: float
    seen: float  # when control first saw it


class _Chain:
    """Samples each of which can follow the one before; the newest of them."""

    def __init__(self, first: _Sample, never: str = "") -> None:
        self.samples = deque([first], maxlen=_KEPT)
        self.never = never  # why it is not believed, however long it lasts

    @property
    def newest(self) -> _Sample:
        return self.samples[-1]

    def recent(self, needed: float) -> list[_Sample]:
        """The newest samples that span `needed` seconds, [] while there are too few."""
        enough: list[_Sample] = []
        for sample in reversed(self.samples):
            enough.append(sample)
            spans = self.newest.captured - sample.captured >= needed - _EPSILON
            if (spans and len(enough) >= _CONSISTENT) or len(enough) == _KEPT:
                return enough
        return []

    def forget(self) -> None:
        """Keep the newest sample alone."""
        newest = self.newest
        self.samples.clear()
        self.samples.append(newest)


class JointPlausibility:
    """Judges each new sample of the joints by those before it.

    A sample is believed where no joint is beyond its limits or has moved faster than it can since the last believed
    one. Samples that contradict that one, and agree with each other for CONSISTENT_S, take its place, later where
    they contradict each other again and again; a joint that jumped to exactly 0, and joints that exchanged their
    values, never do. A joint that reads the same number for `_FROZEN_S` while its command moves is frozen. Grippers and
    speeds are not judged. Nothing can be said of the first samples but that they agree with each other, nor of those
    after UNSEEN_S without any.
    """

    def __init__(self, limits: Limits, dims: DimensionKinds) -> None:
        self._limits = limits
        self._wrapping = dims.wrapping
        self._places = limits.position_mask
        self._chain: _Chain | None = None  # what is believed
        self._other: _Chain | None = None  # what contradicts it
        self._before: Float64 | None = None  # what was believed before the joints were missing
        self._missing = 0.0  # how long they were [s]
        self._needed = CONSISTENT_S  # how long samples have to agree
        self._contradicted = float("-inf")  # when they last did not
        self._captured = float("-inf")
        self._joints: Float64 = np.zeros(0)
        self._judged: float | None = None
        self._unseen = 0.0  # how long there has been no sample; a stall of our own counts little [s]
        self._doubt = ""
        self._digits = _LastDigitActivity(len(limits.names))
        self._frozen = _FrozenJointDetector(limits)
        self.leapt = np.zeros(
            len(limits.names), bool
        )  # were believed elsewhere, and no way was seen to there
        self.dead = ""  # the joints that have read exactly 0 since they came back from somewhere else

    def reset_zeros(self) -> None:
        """The robot is taken over anew: a joint that reads 0 stands there."""
        self.dead = ""

    def judge(self, seen: LatestObservation, now: float, commanded: Float64 | None) -> LatestObservation:
        """`seen` with why its joints are not believed; `commanded` float64 [D] of a robot that is being moved."""
        self._unseen += 0.0 if self._judged is None else min(now - self._judged, _STALL_S)
        self._judged = now
        if not seen.measured:
            return seen
        # A stamp may stay: joints of several messages are as old as the oldest of them. For as long as that, some of
        # them are not seen.
        fresh = seen.joints_captured != self._captured
        if fresh or (self._unseen <= UNSEEN_S and not np.array_equal(seen.joints, self._joints)):
            self._captured, self._joints = seen.joints_captured, seen.joints
            self._doubt = self._take(_Sample(seen.joints, seen.joints_captured, now), commanded)
            self._unseen = 0.0 if fresh else self._unseen
        return replace(seen, implausible_reason=self._doubt) if self._doubt else seen

    @property
    def has_known_sample(self) -> bool:
        """True if any sample was believed since joints were last missing."""
        return self._chain is not None

    @property
    def is_settled(self) -> bool:
        """True if samples have agreed for as long as they have to, up to the newest."""
        return self._chain is not None and not self._doubt and bool(self._chain.recent(self._needed))

    def is_displaced(self, held: Float64, allowed: Float64 | float, but: np.ndarray | bool = False) -> bool:
        """True if all samples that have to agree are farther than `allowed` [rad] or [D] from `held` [D].

        The joints `but`, bool [D], do not count.
        """
        lately = self._chain.recent(self._needed) if self._chain and not self._doubt else []
        return bool(lately) and all(self._away(sample.joints, held, allowed, but) for sample in lately)

    def pop_outage(self) -> float:
        """For how long the joints were missing before those that are believed now came [s]; 0 the second time."""
        missing, self._missing = (0.0 if self._chain is None else self._missing), 0.0
        return missing

    def median_joints(self, joints: Float64) -> Float64:
        """The middle of the newest three believed samples, number by number: a spike among them does not count.

        Angles that wrap are counted in the turn of `joints` [D]. After a gap it is `joints` until there are three:
        those from before it say where the arm was.
        """
        newest = [] if self._chain is None else list(islice(reversed(self._chain.samples), _CONSISTENT))
        gaps = [after.captured - before.captured for after, before in pairwise(newest)]
        if len(newest) < _CONSISTENT or max(gaps) > _GAP_S:
            return joints
        lately = [joints + difference(sample.joints, joints, self._wrapping) for sample in newest]
        return np.asarray(np.median(lately, axis=0))

    def speed(self) -> Float64:
        """Median velocity [D] between the newest believed samples that have to agree: a step among them is none."""
        lately = [] if self._chain is None else self._chain.recent(CONSISTENT_S)
        steps = [
            difference(after.joints, before.joints, self._wrapping)
            / max(after.captured - before.captured, _EPSILON)
            for after, before in pairwise(lately)
        ]
        return np.asarray(np.median(steps, axis=0)) if steps else np.zeros(len(self._limits.names))

    def _take(self, sample: _Sample, commanded: Float64 | None) -> str:
        if self._chain and self._unseen > UNSEEN_S:
            self._before, self._missing = self._chain.newest.joints, self._unseen
            self._chain = self._other = None
            self._needed = CONSISTENT_S
        if beyond := self._beyond(sample.joints):
            self._other = None
            return beyond
        if self._chain is not None and self._continues(self._chain, sample):
            self._digits.add(difference(sample.joints, self._chain.newest.joints, self._wrapping))
            if self._other is not None:  # what was believed before does not agree with this one for that long
                self._chain.samples.clear()
            self._chain.samples.append(sample)
            self._other = None
            stuck = self._stays(self._places & self._digits.leapt, sample.joints)
            return stuck or self._frozen(sample.joints, sample.captured, commanded)
        return self._contradiction(sample)

    def _continues(self, chain: _Chain, sample: _Sample) -> bool:
        """True if the sample follows what is believed, rather than what contradicts it."""
        if self._faster(chain.newest, sample).any() or self._drop_to_zero(chain, sample):
            return False
        if self._has_swapped(chain, sample):
            return False
        other = self._other
        return other is None or self._min_travel_time(chain.newest, sample) <= self._min_travel_time(
            other.newest, sample
        )

    def _min_travel_time(self, before: _Sample, after: _Sample) -> float:
        """Least time from one sample to the other, of the joint that needs longest [s]."""
        moved = np.abs(difference(after.joints, before.joints, self._wrapping)) / self._limits.velocity
        return float(moved.max(where=self._places, initial=0.0))

    def _contradiction(self, sample: _Sample) -> str:
        other = self._other
        if other is not None and not self._faster(other.newest, sample).any():
            self._digits.add_step(difference(sample.joints, other.newest.joints, self._wrapping))
            other.samples.append(sample)
        else:
            if other is not None or self._chain is not None:
                self._contradict(sample.seen)
            self._other = other = _Chain(sample, self._permanent_reason(sample))
        if not other.never and not (stuck := self._stuck(other)) and other.recent(self._needed):
            self.dead = "" if self._before is None else self._zeros(self._before, other.samples[0].joints)
            if (
                self._chain is not None
            ):  # each was seen soon after the one before: a hand moves through samples
                self.leapt |= self._faster(self._chain.newest, other.samples[0], np.inf)
            self._chain, self._other, self._before = other, None, None
            return ""
        return other.never or stuck or self._jump(sample)

    def _contradict(self, now: float) -> None:
        """Believe less of what contradicts itself again and again."""
        again = now - self._contradicted < max(_QUIET_S, 2.0 * self._needed)
        self._needed = min(2.0 * self._needed, _LONGEST_DOUBT_S) if again else CONSISTENT_S
        self._contradicted = now
        if self._chain is not None:
            self._chain.forget()

    def _beyond(self, joints: Float64) -> str:
        limits = self._limits
        beyond = np.where(self._places, limits.excess(joints), 0.0)
        worst = int(beyond.argmax())
        if beyond[worst] <= _BEYOND:
            return ""
        return _BEYOND_LIMITS(
            joint=limits.names[worst],
            value=joints[worst],
            lower=limits.lower[worst],
            upper=limits.upper[worst],
        )

    def _faster(self, before: _Sample, after: _Sample, longest: float = _LONGEST_S) -> np.ndarray:
        """Which joints cannot have come from one sample to the other, for which they had `longest` [s], bool [D]."""
        between = max(after.captured - before.captured, after.seen - before.seen, 0.0)
        allowed = _EXCESS * self._limits.velocity * (min(between, longest) + _NOISE) + _NOISE
        moved = np.abs(difference(after.joints, before.joints, self._wrapping))
        return self._places & (moved > allowed)

    def _jump(self, sample: _Sample) -> str:
        """Contradiction of a sample to what was known, in words."""
        if self._chain is None:
            return _NOT_SEEN_LONG_ENOUGH(seconds=CONSISTENT_S)
        before = self._chain.newest
        jumped = self._faster(before, sample)
        worst = int(np.where(jumped, np.abs(sample.joints - before.joints), 0.0).argmax())
        return _TOO_FAST(
            joint=self._limits.names[worst],
            value=sample.joints[worst],
            before=before.joints[worst],
            speed=self._limits.velocity[worst],
        )

    def _permanent_reason(self, sample: _Sample) -> str:
        """Why samples from this one on are never believed: a question, for numbers alone do not answer it."""
        if self._chain is None:
            return ""
        before = self._chain.newest
        if exchanged := self._swapped_joints(before, sample):
            return _EXCHANGED(joints=exchanged)
        if dead := self._drop_to_zero(self._chain, sample):
            return _ENCODER_DEAD(what=dead)
        return ""

    def _swapped_joints(self, before: _Sample, after: _Sample) -> str:
        """The joints whose values are those of each other, as far as they can have moved meanwhile."""
        away = np.abs(difference(after.joints, before.joints, self._wrapping))
        other = np.flatnonzero(self._places & (away > _SAME))
        apart = np.sort(before.joints[other]) - np.sort(after.joints[other])
        moved = _SAME + self._limits.velocity[other].max(initial=0.0) * min(
            after.seen - before.seen, _LONGEST_S
        )
        if len(other) < 2 or np.abs(apart).max() > moved:
            return ""
        return " and ".join(self._limits.names[i] for i in other)

    def _has_swapped(self, chain: _Chain, sample: _Sample) -> bool:
        """True if joints have leapt, no farther than they can but harder, to exactly each other's values."""
        newest, before = chain.newest, chain.samples[-2 if len(chain.samples) > 1 else -1]
        passed = max(sample.captured - newest.captured, _EPSILON)
        onwards = passed / max(newest.captured - before.captured, _EPSILON)
        went = difference(newest.joints, before.joints, self._wrapping) * onwards
        step = difference(sample.joints, newest.joints, self._wrapping)
        away = np.minimum(np.abs(step), np.abs(step - went))
        leap = max(_LEAP, _HARDEST * passed * passed)
        if (away > leap)[self._places].sum() < 2:
            return False
        for least in (leap, _SAME):  # others may be on their way, one of three may have read nearly the same
            which = self._places & (away > least)
            if np.abs(np.sort(newest.joints[which]) - np.sort(sample.joints[which])).max() <= _SAME:
                return True
        return False

    def _stuck(self, chain: _Chain) -> str:
        """The first joint that has read the same number throughout, far from before, although it was never still."""
        if self._chain is None or len(chain.samples) < _CONSISTENT:
            return ""
        joints = np.array([sample.joints for sample in chain.samples])
        moved = np.abs(difference(joints[-1], self._chain.newest.joints, self._wrapping)) > _SAME
        still = np.ptp(joints, axis=0) == 0.0
        never = self._digits.active
        if (self._places & ~still).any():  # not all have come to rest
            never = never | self._digits.changing
        return self._stays(self._places & never & moved & still, joints[-1])

    def _stays(self, which: np.ndarray, joints: Float64) -> str:
        """The first of the joints `which` that jumped and were still at once, "" where there are none."""
        if not which.any():
            return ""
        first = int(which.argmax())
        return _STUCK(joint=self._limits.names[first], value=joints[first])

    def _drop_to_zero(self, chain: _Chain, sample: _Sample) -> str:
        """The joints that jump to exactly 0, and neither come by it on their way nor go back to it."""
        newest = chain.newest
        if not (zeros := self._zeros(newest.joints, sample.joints)) or len(chain.samples) < _CONSISTENT:
            return zeros
        before, oldest = chain.samples[-2], chain.samples[-3]
        speed = (newest.joints - before.joints) / max(newest.captured - before.captured, _EPSILON)
        way = -newest.joints / max(sample.captured - newest.captured, _EPSILON)
        passes = (speed * way > 0.0) & (np.abs(speed) >= 0.5 * np.abs(way))
        returns = (before.joints == 0.0) | (oldest.joints == 0.0)
        return self._zeros(np.where(passes | returns, 0.0, newest.joints), sample.joints)

    def _zeros(self, before: Float64, after: Float64) -> str:
        """The joints that read exactly 0 and were elsewhere before."""
        dead = np.flatnonzero(self._places & (after == 0.0) & (np.abs(before) > _BEYOND))
        if not len(dead):
            return ""
        was = ", ".join(f"{before[i]:.3f}" for i in dead)
        return _ZERO_AFTER(joints=", ".join(self._limits.names[i] for i in dead), before=was)

    def _away(self, joints: Float64, held: Float64, allowed: Float64 | float, but: np.ndarray | bool) -> bool:
        apart = np.abs(difference(joints, held, self._wrapping))
        return bool((self._places & np.logical_not(but) & (apart > allowed)).any())


class TrustingPlausibility(JointPlausibility):
    """Believes each sample: what moves no robot jumps where its recording begins anew."""

    def judge(self, seen: LatestObservation, now: float, commanded: Float64 | None) -> LatestObservation:
        if seen.measured:
            self._chain = _Chain(_Sample(seen.joints, seen.joints_captured, now))
        return seen

    @property
    def is_settled(self) -> bool:
        return self._chain is not None

    def is_displaced(self, held: Float64, allowed: Float64 | float, but: np.ndarray | bool = False) -> bool:
        return self._chain is not None and self._away(self._chain.newest.joints, held, allowed, but)


class _LastDigitActivity:
    """Which joints are never still, in their last digits: they went there and back, and did not come to rest since."""

    def __init__(self, dim: int) -> None:
        self._step: Float64 = np.zeros(dim)  # the last one that was any
        self._turns = np.zeros(dim, np.int64)
        self._still = np.zeros(dim, np.int64)
        self._leapt = np.zeros(dim, bool)
        self._changed = np.zeros(dim, np.int64)

    def add_step(self, step: Float64) -> None:
        """The difference of two samples [D], believed or not."""
        self._turns += (step * self._step < 0.0) & (np.abs(step) < _DIGITS)
        self._step = np.where(step != 0.0, step, self._step)

    def add(self, step: Float64) -> None:
        """That of two which are believed [D]."""
        self._leapt = np.where(step != 0.0, self.active & (np.abs(step) > _LEAP), self._leapt)
        self.add_step(step)
        self._still = np.where(step == 0.0, self._still + 1, 0)
        self._changed = np.where(step == 0.0, 0, self._changed + 1)
        self._turns[self._still >= _STILL] = 0

    @property
    def active(self) -> np.ndarray:
        """Bool [D]."""
        return np.asarray(self._turns >= _TURNS)

    @property
    def changing(self) -> np.ndarray:
        """Which ones were no more still than that while they moved, bool [D]."""
        return np.asarray(self._changed >= _STILL)

    @property
    def leapt(self) -> np.ndarray:
        """Which ones jumped to a number and have read exactly that for as many samples as say something, bool [D]."""
        return np.asarray(self._leapt & (self._still >= _CONSISTENT - 1))


class _FrozenJointDetector:
    """Notices a joint whose number stays the same, under fresh stamps, while its command moves."""

    def __init__(self, limits: Limits) -> None:
        dim = len(limits.names)
        self._limits = limits
        self._last: Float64 = np.full(dim, np.nan)
        self._since: Float64 = np.zeros(dim)  # when each number was first read
        self._range: Float64 = np.zeros((2, dim))  # of the command since then
        self._moved: Float64 = np.zeros(dim)  # when that was last within what says nothing

    def __call__(self, joints: Float64, captured: float, commanded: Float64 | None) -> str:
        if commanded is None:
            self._last = np.full(len(joints), np.nan)
            return ""
        fresh = joints != self._last
        self._last = joints
        self._since[fresh] = captured
        low, high = self._range
        np.copyto(low, np.where(fresh, commanded, np.minimum(low, commanded)))
        np.copyto(high, np.where(fresh, commanded, np.maximum(high, commanded)))
        self._moved[high - low <= _FROZEN_RAD] = captured
        late = (captured - self._since >= _FROZEN_S) & (captured - self._moved >= _LATENCY_S)
        frozen = self._limits.position_mask & late
        if not frozen.any():
            return ""
        worst = int(np.where(frozen, high - low, 0.0).argmax())
        return _UNMOVED(
            joint=self._limits.names[worst],
            value=joints[worst],
            seconds=captured - self._since[worst],
            distance=high[worst] - low[worst],
        )
