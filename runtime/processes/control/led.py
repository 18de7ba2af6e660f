"""Convergence of a command to the measured joints in several motions, which reveal an encoder with an offset."""

from __future__ import annotations

import numpy as np

from runtime.core.types import Float64

PART = 0.11  # [rad, m] by which a joint is moved before its readings are evaluated
_REST_S = 0.4  # [s] after each part, until a robot that follows late is at rest
_SAY = 2  # parts with the same result; a single one may be wrong, when a hand stops or begins to pull
_DRIFTS = 0.1  # [rad/s] change of a slipping encoder's speed across a part
_THERE = 1e-6


class Led:
    """Convergence of a command to the measured joints, in parts with a rest after each, until two parts agree.

    A part is a motion of the command by at most PART. The comparison of parts distinguishes a joint that is moved by
    hand from a joint whose encoder has an offset. The readings of a joint moved by hand do not depend on the command.
    The readings of an encoder with an offset follow the command, and rest (or drift on) when the command rests.

    For each part, the motion of the readings is compared with the motion that their speed before and after the part
    explains. If in two parts the readings moved with the command by more than that, and the excess is more than half of
    the command's motion, the encoder has an offset. A part is inconclusive if the readings' speed changed during it, as
    with a hand that moves to and fro, unless the readings moved against the command.
    """

    def __init__(
        self,
        commanded: Float64,
        measured: Float64,
        speed: Float64,
        now: float,
        *,
        at_once: np.ndarray | bool = False,
        along: np.ndarray | int = 0,
    ) -> None:
        """Start at `commanded` [D], with readings at `measured` [D] that move at `speed` [D] by themselves.

        Args:
            commanded: Command at the start [D].
            measured: Readings at the start [D].
            speed: Velocity of the readings at the start [D].
            now: Present time [s].
            at_once: True for joints that converge in one motion, bool [D]; the others converge in parts with a rest
                after each. During a rest, the command would pull back an arm whose drive is switched on again, and a
                blocked arm would continue to press.
            along: Number of parts in earlier convergences in which the readings of a joint moved with the command, int
                [D].
        """
        self.at_once = np.broadcast_to(np.asarray(at_once, bool), commanded.shape)
        self.along: np.ndarray = np.zeros(len(commanded), np.int64) + along
        self._alone = np.zeros(len(commanded), np.int64)
        self._begin(commanded, measured, speed, now)

    def _begin(self, commanded: Float64, measured: Float64, speed: Float64, now: float) -> None:
        self._from, self._read, self._speed, self._at = commanded.copy(), measured.copy(), speed, now
        self._rests: float | None = None  # start of the rest at the end of the part

    @property
    def alone(self) -> np.ndarray:
        """Joints proven to move independently of the command, bool [D]."""
        return np.asarray(self._alone >= _SAY)

    @property
    def verdict(self) -> np.ndarray:
        """Evidence for each joint that its readings follow the command, int [D].

        It is the number of parts of the convergence in which the readings moved with the command, minus the number of
        parts in which they did not.
        """
        return np.asarray(self.along - self._alone)

    @property
    def whole(self) -> np.ndarray:
        """Joints that converge the remaining distance in a single motion, without rests, bool [D]."""
        return np.asarray(self.at_once | self.alone)

    def end(self, goal: Float64) -> Float64:
        """Return the command [D] at which the present part ends: as close to `goal` [D] as this part may come."""
        return np.where(self.whole, goal, np.clip(goal, self._from - PART, self._from + PART))

    def update(
        self, commanded: Float64, measured: Float64, goal: Float64, speed: Float64, now: float
    ) -> np.ndarray:
        """Evaluate the readings once a part and the rest after it have ended.

        Return the joints whose readings moved with the command, bool [D]. A joint is among them as soon as this was so
        in enough parts. Parts of earlier convergences count too.

        Args:
            commanded: Present command [D].
            measured: Present readings [D].
            goal: End of the convergence [D].
            speed: Present velocity of the readings [D].
            now: Present time [s].
        """
        off = np.asarray(self.along >= _SAY)
        if np.abs(self.end(goal) - commanded).max(where=~self.whole, initial=0.0) > _THERE:
            return off
        self._rests = now if self._rests is None else self._rests
        if now - self._rests < _REST_S:
            return off
        commanded_travel = commanded - self._from
        alone = (self._speed + speed) / 2.0 * (now - self._at)
        went = (measured - self._read) * np.sign(commanded_travel)
        goes_along = went - alone * np.sign(commanded_travel) > np.abs(commanded_travel) / 2.0
        far, steady = np.abs(commanded_travel) > PART / 2.0, np.abs(speed - self._speed) <= _DRIFTS
        says = ~self.whole & far & (steady | (went < -PART / 2.0))
        self.along += says & goes_along
        self._alone += says & ~goes_along
        self._begin(commanded, measured, speed, now)
        return np.asarray(self.along >= _SAY)
