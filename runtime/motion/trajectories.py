"""Generated motions: trajectories between two poses within limits, and braking to rest."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from runtime.core.types import Float64


class Motion(ABC):
    """Motion that ends at rest: a position for each time since its start."""

    duration: float  # [s]

    @abstractmethod
    def at(self, elapsed: float) -> Float64:
        """Return the position [D] `elapsed` seconds after the start; from `duration` on it is the end position."""


class Brake(Motion):
    """Motion of joints that decelerate constantly to rest, never beyond `lower` and `upper`.

    Dimensions in `speeds` are themselves speeds: each decreases to 0 at its rate in `slowing` [D].
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
        # A joint that is outside its limits already must not jump back to them.
        self._lower, self._upper = np.minimum(lower, q), np.maximum(upper, q)
        self._stop = np.abs(velocity) / deceleration
        self._speeds = list(speeds)
        if self._speeds:
            assert slowing is not None
            self._stop[self._speeds] = np.abs(q[self._speeds]) / slowing[self._speeds]
        self.duration = float(self._stop.max(initial=0.0))

    def at(self, elapsed: float) -> Float64:
        t = np.minimum(elapsed, self._stop)
        distance = self._velocity * t - 0.5 * np.sign(self._velocity) * self._deceleration * t * t
        position = np.clip(self._q + distance, self._lower, self._upper)
        if self._speeds:
            stop = np.maximum(self._stop[self._speeds], 1e-9)
            position[self._speeds] = self._q[self._speeds] * np.maximum(0.0, 1.0 - elapsed / stop)
        return position

    def velocity(self, elapsed: float) -> Float64:
        """Return the velocity [D] at `elapsed` [s].

        Because the joints decelerate, it is less than their mean velocity over a tick that ends at that time.
        """
        velocity = np.sign(self._velocity) * np.maximum(
            np.abs(self._velocity) - self._deceleration * elapsed, 0.0
        )
        if self._speeds:
            stop = np.maximum(self._stop[self._speeds], 1e-9)
            velocity[self._speeds] = np.where(elapsed < stop, -self._q[self._speeds] / stop, 0.0)
        return np.asarray(velocity)

    def sample_path(self, spacing: float, most: int) -> Float64:
        """Return positions [N, D] along the braking path; the last one is at rest.

        No joint moves more than `spacing` between two of them, unless that would need more than `most` positions.
        """
        farthest = np.abs(0.5 * self._velocity * self._stop).max(initial=0.0)
        count = int(min(max(np.ceil(farthest / spacing), 1), most))
        return np.array([self.at(self.duration * (i + 1) / count) for i in range(count)])


class Trajectory(Motion):
    """Motion on a straight line in joint space from rest to rest, all joints synchronised, with a trapezoidal speed
    profile.

    No joint exceeds its velocity [rad/s] or acceleration [rad/s2]; the slowest joint determines the duration.
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
        self._speed = min(self._speed, float(np.sqrt(self._rate)))  # a short path never reaches full speed
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
