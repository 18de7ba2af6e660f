"""Motions of our own: going somewhere within limits, and coming to a stand."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from runtime.core.types import Float64


class Motion(ABC):
    """A position for every moment since its start, ending at rest."""

    duration: float  # [s]

    @abstractmethod
    def at(self, elapsed: float) -> Float64:
        """The position [D] `elapsed` seconds after the start; the end position from `duration` on."""


class Brake(Motion):
    """Constant deceleration of every joint from its velocity to rest, never beyond `lower` and `upper`.

    The numbers at `speeds` are speeds themselves: they go to 0 at the rate `slowing` [D].
    """

    def __init__(
        self,
        q: Float64,
        velocity: Float64,
        deceleration: Float64,
        lower: Float64,
        upper: Float64,
        speeds: tuple[int, ...] = (),
        slowing: Float64 | None = None,
    ) -> None:
        self._q, self._velocity = q, velocity
        self._deceleration = deceleration
        # A joint that is outside already may stay there.
        self._lower, self._upper = np.minimum(lower, q), np.maximum(upper, q)
        self._stop = np.abs(velocity) / deceleration
        self._speeds = list(speeds)
        if self._speeds:
            assert slowing is not None
            self._stop[self._speeds] = np.abs(q[self._speeds]) / slowing[self._speeds]
        self.duration = float(self._stop.max(initial=0.0))

    def at(self, elapsed: float) -> Float64:
        t = np.minimum(elapsed, self._stop)
        way = self._velocity * t - 0.5 * np.sign(self._velocity) * self._deceleration * t * t
        position = np.clip(self._q + way, self._lower, self._upper)
        if self._speeds:
            stop = np.maximum(self._stop[self._speeds], 1e-9)
            position[self._speeds] = self._q[self._speeds] * np.maximum(0.0, 1.0 - elapsed / stop)
        return position

    def velocity(self, elapsed: float) -> Float64:
        """Velocity of each number then [D]: less than on average since the tick before."""
        velocity = np.sign(self._velocity) * np.maximum(
            np.abs(self._velocity) - self._deceleration * elapsed, 0.0
        )
        if self._speeds:
            stop = np.maximum(self._stop[self._speeds], 1e-9)
            velocity[self._speeds] = np.where(elapsed < stop, -self._q[self._speeds] / stop, 0.0)
        return np.asarray(velocity)

    def sample_path(self, spacing: float, most: int) -> Float64:
        """Positions [N, D] on the way to the stand, which ends it, `spacing` apart at most and `most` of them."""
        farthest = np.abs(0.5 * self._velocity * self._stop).max(initial=0.0)
        count = int(min(max(np.ceil(farthest / spacing), 1), most))
        return np.array([self.at(self.duration * (i + 1) / count) for i in range(count)])


class Trajectory(Motion):
    """A straight line in joint space from rest to rest, all joints in step, on a trapezoidal speed profile.

    No joint exceeds its velocity [rad/s] or acceleration [rad/s2]; the slowest joint sets the time.
    """

    def __init__(self, start: Float64, goal: Float64, velocity: Float64, acceleration: Float64) -> None:
        self._start, self._delta = np.asarray(start, np.float64), np.asarray(goal, np.float64) - start
        distance = np.abs(self._delta)
        moving = distance > 1e-9
        if not moving.any():
            self._speed = self._rate = 1.0
            self._ramp = self._cruise = self.duration = 0.0
            return
        self._speed = float((velocity[moving] / distance[moving]).min())  # of the path parameter 0..1 [1/s]
        self._rate = float((acceleration[moving] / distance[moving]).min())  # [1/s2]
        self._speed = min(self._speed, float(np.sqrt(self._rate)))  # a short way never reaches full speed
        self._ramp = self._speed / self._rate
        self._cruise = 1.0 / self._speed - self._ramp
        self.duration = 2.0 * self._ramp + self._cruise

    def at(self, elapsed: float) -> Float64:
        if elapsed >= self.duration:
            return self._start + self._delta
        t = max(elapsed, 0.0)
        if t < self._ramp:
            part = 0.5 * self._rate * t * t
        elif t < self._ramp + self._cruise:
            part = 0.5 * self._speed * self._ramp + self._speed * (t - self._ramp)
        else:
            left = self.duration - t
            part = 1.0 - 0.5 * self._rate * left * left
        return self._start + part * self._delta
