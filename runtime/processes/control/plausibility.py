"""Plausibility of joint measurements: a single bad sample must not move the robot."""

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
    "joint positions have been received for less than {seconds:g} s",
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

UNSEEN_S = 0.5  # [s] without joints, after which the robot may have been moved unobserved
CONSISTENT_S = 0.1  # [s] of agreement after which contradicting samples are trusted
_CONSISTENT = 3  # least number of samples in that time
_EXCESS = 2.0  # factor on the velocity limit for a joint pushed by hand
_NOISE = 0.02  # [rad] and [s] error of a sample and of its stamp
_LONGEST_S = 0.05  # [s] without a sample beyond which the permitted motion does not grow
_STALL_S = 0.1  # [s] stall of our own between two checks, which does not count as an outage
_BEYOND = 0.1  # [rad] that an arm may be beyond its limits
_FROZEN_S, _FROZEN_RAD = 1.0, 0.05
_LATENCY_S = 0.3  # [s] by which a stationary robot may follow its command late
_TURNS = 3  # reversals in the last digits of an encoder that never rests
_STILL = 5  # equal samples of an encoder at rest
_DIGITS = 1e-3  # [rad] largest value of an encoder's last digits
_LEAP = 0.1  # [rad] between two samples, after which no joint stops within the next sample
_HARDEST = 100.0  # [rad/s2] greater than the acceleration of any joint
_SAME = 0.02  # [rad] tolerance for exchanged values of two joints
_LONGEST_DOUBT_S = 2.0
_KEPT = 512  # samples that suffice even if they span a short time at a high rate
_QUIET_S = 1.0  # [s] without a contradiction after which the next counts as the first
_GAP_S = 0.15  # [s] between two samples in which a moving arm has changed its position
_EPSILON = 1e-6  # [s] rounding tolerance of stamps


class _Sample(NamedTuple):
    joints: Float64  # [D]
    captured: float
    seen: float  # time at which control received it


class _Chain:
    """Samples, each consistent with its predecessor."""

    def __init__(self, first: _Sample, never: str = "") -> None:
        self.samples = deque([first], maxlen=_KEPT)
        self.never = never  # reason to distrust it forever, "" if there is none

    @property
    def newest(self) -> _Sample:
        return self.samples[-1]

    def recent(self, needed: float) -> list[_Sample]:
        """Return the newest samples that span `needed` seconds, [] while there are too few."""
        enough: list[_Sample] = []
        for sample in reversed(self.samples):
            enough.append(sample)
            spans = self.newest.captured - sample.captured >= needed - _EPSILON
            if (spans and len(enough) >= _CONSISTENT) or len(enough) == _KEPT:
                return enough
        return []

    def forget(self) -> None:
        """Remove all samples but the newest."""
        newest = self.newest
        self.samples.clear()
        self.samples.append(newest)


class JointPlausibility:
    """Plausibility check of each joint sample against earlier samples.

    A sample is trusted if no joint is beyond its limits, and none has moved faster than possible since the last trusted
    sample. Samples that contradict the trusted samples, but agree with each other for CONSISTENT_S, replace them; the
    required time grows if contradictions repeat. Samples in which a joint jumped to exactly 0, or joints exchanged
    their values, never replace trusted samples. A joint counts as frozen if its reading has been the same number for
    `_FROZEN_S` while its command moved. Grippers and speeds are not checked. The first samples, and those after an
    outage of UNSEEN_S, can only be checked for agreement with each other.
    """

    def __init__(self, limits: Limits, dims: DimensionKinds) -> None:
        self._limits = limits
        self._wrapping = dims.wrapping
        self._places = limits.position_mask
        self._chain: _Chain | None = None  # trusted samples
        self._other: _Chain | None = None  # samples that contradict them
        self._before: Float64 | None = None  # last trusted joints before an outage
        self._missing = 0.0  # duration of the outage [s]
        self._needed = CONSISTENT_S  # for how long samples must agree [s]
        self._contradicted = float("-inf")  # time of the last contradiction
        self._captured = float("-inf")
        self._joints: Float64 = np.zeros(0)
        self._judged: float | None = None
        self._unseen = 0.0  # time without a sample [s]; a stall of our own is capped
        self._doubt = ""
        self._digits = _LastDigitActivity(len(limits.names))
        self._frozen = _FrozenJointDetector(limits)
        # Joints that reached their trusted position without a measured path.
        self.leapt = np.zeros(len(limits.names), bool)
        self.dead = ""  # joints that read exactly 0 since they returned from elsewhere

    def reset_zeros(self) -> None:
        """Accept joints that read exactly 0, because the robot is being engaged anew."""
        self.dead = ""

    def judge(self, seen: LatestObservation, now: float, commanded: Float64 | None) -> LatestObservation:
        """Return `seen` unchanged, or with the reason added if its joints are implausible.

        `commanded` float64 [D] is the command of a robot that is being moved, None otherwise.
        """
        self._unseen += 0.0 if self._judged is None else min(now - self._judged, _STALL_S)
        self._judged = now
        if not seen.measured:
            return seen
        # A stamp may repeat: joints from several messages have the stamp of the oldest. During that time some
        # of them are unknown.
        fresh = seen.joints_captured != self._captured
        if fresh or (self._unseen <= UNSEEN_S and not np.array_equal(seen.joints, self._joints)):
            self._captured, self._joints = seen.joints_captured, seen.joints
            self._doubt = self._accept(_Sample(seen.joints, seen.joints_captured, now), commanded)
            self._unseen = 0.0 if fresh else self._unseen
        return replace(seen, implausible_reason=self._doubt) if self._doubt else seen

    @property
    def has_known_sample(self) -> bool:
        """Whether any sample was trusted since joints were last missing."""
        return self._chain is not None

    @property
    def is_settled(self) -> bool:
        """Whether all samples of the required time, up to the newest, have agreed."""
        return self._chain is not None and not self._doubt and bool(self._chain.recent(self._needed))

    def is_displaced(self, held: Float64, allowed: Float64 | float, but: np.ndarray | bool = False) -> bool:
        """Return True if the robot is farther than `allowed` ([rad] or [D]) from the position `held` [D].

        This must be so in all of the newest samples over the time for which samples must agree to be trusted. The
        result is False if the samples are doubtful or too few. The joints in `but`, bool [D], are ignored.
        """
        lately = self._chain.recent(self._needed) if self._chain and not self._doubt else []
        return bool(lately) and all(self._away(sample.joints, held, allowed, but) for sample in lately)

    def pop_outage(self) -> float:
        """Return the duration [s] of the outage after which the present samples became trusted, and forget it.

        The result is 0 if no samples are trusted, if there was no outage, or if its duration was returned before.
        """
        missing, self._missing = (0.0 if self._chain is None else self._missing), 0.0
        return missing

    def median_joints(self, joints: Float64) -> Float64:
        """Return the median of the newest three trusted samples for each joint, which removes a spike.

        An angle that wraps is returned in the same turn as its value in `joints` [D]. After a gap in the measurements,
        `joints` are returned until there are three new samples, because the earlier samples are from before the gap.
        """
        newest = [] if self._chain is None else list(islice(reversed(self._chain.samples), _CONSISTENT))
        gaps = [after.captured - before.captured for after, before in pairwise(newest)]
        if len(newest) < _CONSISTENT or max(gaps) > _GAP_S:
            return joints
        lately = [joints + difference(sample.joints, joints, self._wrapping) for sample in newest]
        return np.asarray(np.median(lately, axis=0))

    def speed(self) -> Float64:
        """Return the median velocity [D] between the newest trusted samples.

        The samples are those that span the last CONSISTENT_S seconds; the velocity is 0 while there are too few of
        them. Because of the median, a single step of a reading does not change the result.
        """
        lately = [] if self._chain is None else self._chain.recent(CONSISTENT_S)
        steps = [
            difference(after.joints, before.joints, self._wrapping)
            / max(after.captured - before.captured, _EPSILON)
            for after, before in pairwise(lately)
        ]
        return np.asarray(np.median(steps, axis=0)) if steps else np.zeros(len(self._limits.names))

    def _accept(self, sample: _Sample, commanded: Float64 | None) -> str:
        if self._chain and self._unseen > UNSEEN_S:
            self._before, self._missing = self._chain.newest.joints, self._unseen
            self._chain = self._other = None
            self._needed = CONSISTENT_S
        if beyond := self._beyond(sample.joints):
            self._other = None
            return beyond
        if self._chain is not None and self._continues(self._chain, sample):
            self._digits.add(difference(sample.joints, self._chain.newest.joints, self._wrapping))
            if self._other is not None:  # the trusted samples before contradict this one during that time
                self._chain.samples.clear()
            self._chain.samples.append(sample)
            self._other = None
            stuck = self._stays(self._places & self._digits.leapt, sample.joints)
            return stuck or self._frozen(sample.joints, sample.captured, commanded)
        return self._contradiction(sample)

    def _continues(self, chain: _Chain, sample: _Sample) -> bool:
        """Return True if `sample` continues the trusted samples, rather than the samples that contradict them."""
        if self._faster(chain.newest, sample).any() or self._drop_to_zero(chain, sample):
            return False
        if self._has_swapped(chain, sample):
            return False
        rival = self._other
        return rival is None or self._min_travel_time(chain.newest, sample) <= self._min_travel_time(
            rival.newest, sample
        )

    def _min_travel_time(self, before: _Sample, after: _Sample) -> float:
        """Return the least time [s] in which all joints can move from one sample to the other."""
        moved = np.abs(difference(after.joints, before.joints, self._wrapping)) / self._limits.velocity
        return float(moved.max(where=self._places, initial=0.0))

    def _contradiction(self, sample: _Sample) -> str:
        rival = self._other
        if rival is not None and not self._faster(rival.newest, sample).any():
            self._digits.add_step(difference(sample.joints, rival.newest.joints, self._wrapping))
            rival.samples.append(sample)
        else:
            if rival is not None or self._chain is not None:
                self._contradict(sample.seen)
            self._other = rival = _Chain(sample, self._permanent_reason(sample))
        if not rival.never and not (stuck := self._stuck(rival)) and rival.recent(self._needed):
            self.dead = "" if self._before is None else self._zeros(self._before, rival.samples[0].joints)
            if (
                self._chain is not None
            ):  # samples were continuous: a hand moves gradually, so a faster change is a leap
                self.leapt |= self._faster(self._chain.newest, rival.samples[0], np.inf)
            self._chain, self._other, self._before = rival, None, None
            return ""
        return rival.never or stuck or self._jump(sample)

    def _contradict(self, now: float) -> None:
        """Require longer agreement after repeated contradictions."""
        repeated = now - self._contradicted < max(_QUIET_S, 2.0 * self._needed)
        self._needed = min(2.0 * self._needed, _LONGEST_DOUBT_S) if repeated else CONSISTENT_S
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
        """Return which joints, bool [D], moved more between two samples than they can.

        The time between the samples counts at most as `longest` [s].
        """
        between = max(after.captured - before.captured, after.seen - before.seen, 0.0)
        allowed = _EXCESS * self._limits.velocity * (min(between, longest) + _NOISE) + _NOISE
        moved = np.abs(difference(after.joints, before.joints, self._wrapping))
        return self._places & (moved > allowed)

    def _jump(self, sample: _Sample) -> str:
        """Return a message about how `sample` contradicts the trusted samples."""
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
        """Return the reason why samples from this one on are never trusted, "" if there is none.

        The reason is phrased as a question, because numbers alone cannot prove it.
        """
        if self._chain is None:
            return ""
        before = self._chain.newest
        if exchanged := self._swapped_joints(before, sample):
            return _EXCHANGED(joints=exchanged)
        if dead := self._drop_to_zero(self._chain, sample):
            return _ENCODER_DEAD(what=dead)
        return ""

    def _swapped_joints(self, before: _Sample, after: _Sample) -> str:
        """Return the names of joints that have exchanged their values between two samples, "" if there are none.

        The values need not be exactly equal: they may differ by the distance that the joints can move between the
        samples.
        """
        away = np.abs(difference(after.joints, before.joints, self._wrapping))
        moved_joints = np.flatnonzero(self._places & (away > _SAME))
        apart = np.sort(before.joints[moved_joints]) - np.sort(after.joints[moved_joints])
        moved = _SAME + self._limits.velocity[moved_joints].max(initial=0.0) * min(
            after.seen - before.seen, _LONGEST_S
        )
        if len(moved_joints) < 2 or np.abs(apart).max() > moved:
            return ""
        return " and ".join(self._limits.names[i] for i in moved_joints)

    def _has_swapped(self, chain: _Chain, sample: _Sample) -> bool:
        """Return True if joints jumped to each other's values, within their velocity but beyond any acceleration."""
        newest, before = chain.newest, chain.samples[-2 if len(chain.samples) > 1 else -1]
        passed = max(sample.captured - newest.captured, _EPSILON)
        onwards = passed / max(newest.captured - before.captured, _EPSILON)
        went = difference(newest.joints, before.joints, self._wrapping) * onwards
        step = difference(sample.joints, newest.joints, self._wrapping)
        away = np.minimum(np.abs(step), np.abs(step - went))
        leap = max(_LEAP, _HARDEST * passed * passed)
        if (away > leap)[self._places].sum() < 2:
            return False
        for least in (leap, _SAME):  # others may be moving; one of three may be nearly equal
            which = self._places & (away > least)
            if np.abs(np.sort(newest.joints[which]) - np.sort(sample.joints[which])).max() <= _SAME:
                return True
        return False

    def _stuck(self, chain: _Chain) -> str:
        """Return a message about a joint that now reads a constant far from its trusted reading, "" if there is none.

        Only joints whose last digits usually change with every sample are checked: a constant reading is normal for all
        others.
        """
        if self._chain is None or len(chain.samples) < _CONSISTENT:
            return ""
        joints = np.array([sample.joints for sample in chain.samples])
        moved = np.abs(difference(joints[-1], self._chain.newest.joints, self._wrapping)) > _SAME
        still = np.ptp(joints, axis=0) == 0.0
        never = self._digits.active
        if (self._places & ~still).any():  # some are still moving
            never = never | self._digits.changing
        return self._stays(self._places & never & moved & still, joints[-1])

    def _stays(self, which: np.ndarray, joints: Float64) -> str:
        """Return a message that the first joint of `which` (bool [D]) jumped to a constant; "" if `which` has none."""
        if not which.any():
            return ""
        first = int(which.argmax())
        return _STUCK(joint=self._limits.names[first], value=joints[first])

    def _drop_to_zero(self, chain: _Chain, sample: _Sample) -> str:
        """Return a message about joints that jump to exactly 0, "" if there are none.

        Joints that pass through 0 at their speed, or return to it, do not count.
        """
        newest = chain.newest
        if not (zeros := self._zeros(newest.joints, sample.joints)) or len(chain.samples) < _CONSISTENT:
            return zeros
        before, oldest = chain.samples[-2], chain.samples[-3]
        speed = (newest.joints - before.joints) / max(newest.captured - before.captured, _EPSILON)
        drop_velocity = -newest.joints / max(sample.captured - newest.captured, _EPSILON)
        passes = (speed * drop_velocity > 0.0) & (np.abs(speed) >= 0.5 * np.abs(drop_velocity))
        returns = (before.joints == 0.0) | (oldest.joints == 0.0)
        return self._zeros(np.where(passes | returns, 0.0, newest.joints), sample.joints)

    def _zeros(self, before: Float64, after: Float64) -> str:
        """Return a message on joints that read exactly 0 and were elsewhere before; "" if there are none."""
        dead = np.flatnonzero(self._places & (after == 0.0) & (np.abs(before) > _BEYOND))
        if not len(dead):
            return ""
        was = ", ".join(f"{before[i]:.3f}" for i in dead)
        return _ZERO_AFTER(joints=", ".join(self._limits.names[i] for i in dead), before=was)

    def _away(
        self, joints: Float64, reference: Float64, allowed: Float64 | float, but: np.ndarray | bool
    ) -> bool:
        apart = np.abs(difference(joints, reference, self._wrapping))
        return bool((self._places & np.logical_not(but) & (apart > allowed)).any())


class TrustingPlausibility(JointPlausibility):
    """Plausibility check that trusts every sample.

    It is used if no robot moves: the joints of a replayed recording jump when it starts again.
    """

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
    """Detector of joints whose readings never rest in their last digits.

    A joint counts if its reading reversed several times by small steps, and has not been constant since.
    """

    def __init__(self, dim: int) -> None:
        self._step: Float64 = np.zeros(dim)  # the last one that was not 0
        self._turns = np.zeros(dim, np.int64)
        self._still = np.zeros(dim, np.int64)
        self._leapt = np.zeros(dim, bool)
        self._changed = np.zeros(dim, np.int64)

    def add_step(self, step: Float64) -> None:
        """Add the difference of two samples [D], trusted or not."""
        self._turns += (step * self._step < 0.0) & (np.abs(step) < _DIGITS)
        self._step = np.where(step != 0.0, step, self._step)

    def add(self, step: Float64) -> None:
        """Add the difference of two trusted samples [D]."""
        self._leapt = np.where(step != 0.0, self.active & (np.abs(step) > _LEAP), self._leapt)
        self.add_step(step)
        self._still = np.where(step == 0.0, self._still + 1, 0)
        self._changed = np.where(step == 0.0, 0, self._changed + 1)
        self._turns[self._still >= _STILL] = 0

    @property
    def active(self) -> np.ndarray:
        """Joints whose last digits never rest, bool [D]."""
        return np.asarray(self._turns >= _TURNS)

    @property
    def changing(self) -> np.ndarray:
        """Joints, bool [D], whose reading changed with each of the last samples."""
        return np.asarray(self._changed >= _STILL)

    @property
    def leapt(self) -> np.ndarray:
        """Joints, bool [D], that jumped to a number and have read exactly this number in all samples since."""
        return np.asarray(self._leapt & (self._still >= _CONSISTENT - 1))


class _FrozenJointDetector:
    """Detector of a joint whose reading stays at the same number while its command moves.

    The stamps of the readings advance meanwhile, so that the readings look fresh.
    """

    def __init__(self, limits: Limits) -> None:
        dim = len(limits.names)
        self._limits = limits
        self._last: Float64 = np.full(dim, np.nan)
        self._since: Float64 = np.zeros(dim)  # first time of each number
        self._range: Float64 = np.zeros((2, dim))  # range of the command since then
        self._moved: Float64 = np.zeros(dim)  # last time that the range was too small for a conclusion

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
