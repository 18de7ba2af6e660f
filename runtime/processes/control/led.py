"""A command that is led to where joints are read: first in parts, for an encoder that is off goes along with it."""

from __future__ import annotations

import numpy as np

from runtime.core.types import Float64

PART = 0.11  # rad (m) that a joint is led before its readings are looked at
_REST_S = 0.4  # after each part: what follows a command, late as it may be, has come to a stand
_SAY = 2  # parts that have to say the same; of three one may be wrong, where a hand stops or begins to pull
_DRIFTS = (
    0.1  # [rad/s] by which readings of a slipping encoder go faster or slower after a part than before it
)
_THERE = 1e-6


class Led:
    """The way of a command to where joints are read, in parts with a rest after each until two of them agree.

    Readings of a joint that a hand moves go on as the hand does, whatever its command does. Those of a joint that
    follows its command, and is read somewhere else by an encoder that is off, go with the command, and stand (or slip
    on) with it. So what counts is how far readings went in a part beyond what their speeds before and after it make:
    where that is more than half of the command's way in two parts, the encoder is off. A part after which readings go
    on at another speed than before, as those of a hand that goes to and fro do, says nothing, but where they came
    against the command.
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
        """From `commanded` [D], while joints are read at `measured` [D] and go at `speed` [D] by themselves.

        `at_once`, bool [D]: without parts, or an arm that was switched off and on again would be pulled back meanwhile,
        and one that is blocked would go on pressing. `along`, int [D]: parts of former ways in which readings went
        along.
        """
        self.at_once = np.broadcast_to(np.asarray(at_once, bool), commanded.shape)
        self.along: np.ndarray = np.zeros(len(commanded), np.int64) + along
        self._alone = np.zeros(len(commanded), np.int64)
        self._begin(commanded, measured, speed, now)

    def _begin(self, commanded: Float64, measured: Float64, speed: Float64, now: float) -> None:
        self._from, self._read, self._speed, self._at = commanded.copy(), measured.copy(), speed, now
        self._rests: float | None = None  # since when the command has stood at the end of the part

    @property
    def alone(self) -> np.ndarray:
        """Joints whose readings were seen not to go along, bool [D]."""
        return np.asarray(self._alone >= _SAY)

    @property
    def verdict(self) -> np.ndarray:
        """By how many parts more each joint goes along than it does not, int [D]."""
        return np.asarray(self.along - self._alone)

    @property
    def whole(self) -> np.ndarray:
        """Joints that are led the rest of the way without a rest, bool [D]."""
        return np.asarray(self.at_once | self.alone)

    def end(self, goal: Float64) -> Float64:
        """How far the command may be led to `goal` now [D]."""
        return np.where(self.whole, goal, np.clip(goal, self._from - PART, self._from + PART))

    def look(
        self, commanded: Float64, measured: Float64, goal: Float64, speed: Float64, now: float
    ) -> np.ndarray:
        """The joints, bool [D], whose readings have gone along with the command."""
        off = np.asarray(self.along >= _SAY)
        if np.abs(self.end(goal) - commanded).max(where=~self.whole, initial=0.0) > _THERE:
            return off
        self._rests = now if self._rests is None else self._rests
        if now - self._rests < _REST_S:
            return off
        way = commanded - self._from
        alone = (self._speed + speed) / 2.0 * (now - self._at)
        went = (measured - self._read) * np.sign(way)
        goes_along = went - alone * np.sign(way) > np.abs(way) / 2.0
        far, steady = np.abs(way) > PART / 2.0, np.abs(speed - self._speed) <= _DRIFTS
        says = ~self.whole & far & (steady | (went < -PART / 2.0))
        self.along += says & goes_along
        self._alone += says & ~goes_along
        self._begin(commanded, measured, speed, now)
        return np.asarray(self.along >= _SAY)
