"""A command that is led to where joints are read: first in parts, for an encoder that is off goes along with it."""

from __future__ import annotations

import numpy as np

from runtime.core.types import Float64

PART = 0.11  # rad (m) that a joint is led before its readings are looked at
_REST_S = 0.4  # after each part: what follows a command, late as it may be, has come to a stand
_SAY = 2  # parts that have to say the same; of three one may be wrong, where a hand stops or begins to pull
_THERE = 1e-6


class Led:
    """The way of a command to where joints are read, in parts with a rest after each until two of them agree.

    Readings of a joint that a hand moves go on as the hand does, whatever its command does. Those of a joint that
    follows its command, and is read somewhere else by an encoder that is off, go with the command, and stand (or slip
    on) with it. So what counts is how far readings went in a part beyond what their speeds before and after it make:
    where that is more than half of the command's way in two parts, the encoder is off.
    """

    def __init__(
        self, commanded: Float64, measured: Float64, speed: Float64, now: float, *, at_once: bool = False
    ) -> None:
        """From `commanded` [D], while joints are read at `measured` [D] and go at `speed` [D] by themselves.

        `at_once`: without parts, or an arm that was switched off and on again would be pulled back meanwhile, and one
        that is blocked would go on pressing.
        """
        self.at_once = at_once
        self._along = np.zeros(len(commanded), np.int64)
        self._parts = 0
        self._begin(commanded, measured, speed, now)

    def _begin(self, commanded: Float64, measured: Float64, speed: Float64, now: float) -> None:
        self._from, self._read, self._speed, self._at = commanded.copy(), measured.copy(), speed, now
        self._rests: float | None = None  # since when the command has stood at the end of the part

    @property
    def proven(self) -> bool:
        """Whether readings were seen not to go along."""
        return self._parts > _SAY or (self._parts == _SAY and not self._along.any())

    @property
    def whole(self) -> bool:
        """Whether the rest of the way is led without a rest."""
        return self.at_once or self.proven

    def end(self, goal: Float64) -> Float64:
        """How far the command may be led to `goal` now [D]."""
        return goal if self.whole else np.clip(goal, self._from - PART, self._from + PART)

    def look(
        self, commanded: Float64, measured: Float64, goal: Float64, speed: Float64, now: float
    ) -> np.ndarray:
        """The joints, bool [D], whose readings have gone along with the command."""
        none = np.zeros(len(commanded), bool)
        if self.whole or np.abs(self.end(goal) - commanded).max() > _THERE:
            return none
        self._rests = now if self._rests is None else self._rests
        if now - self._rests < _REST_S:
            return none
        way = commanded - self._from
        alone = (self._speed + speed) / 2.0 * (now - self._at)
        went = (measured - self._read - alone) * np.sign(way)
        self._along += (np.abs(way) > PART / 2.0) & (went > np.abs(way) / 2.0)
        self._parts += 1
        self._begin(commanded, measured, speed, now)
        return np.asarray(self._along >= _SAY)
