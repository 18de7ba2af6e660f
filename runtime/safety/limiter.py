"""Command limiter: the last check, which applies to every command whatever its origin."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.safety.limits import Limits
from runtime.safety.settings import SafetySettings

_LAST_CHECK = Pattern("safety.last_check", "last check: {joint} {wanted:.4f} was to be sent, {sent:.4f} is")

_MARGIN = 1.05  # for rounding and unequal ticks
_TOLERANCE = 1e-6  # [rad, or a gripper's equivalent]


class LimitedCommand(NamedTuple):
    """Command that may be sent, float64 [D], with a note for each number that was changed."""

    action: Float64
    notes: tuple[str, ...] = ()


class CommandLimiter:
    """Last limit on every command: each number is made finite and kept within its limits.

    The limits are those of position, velocity and acceleration. Velocity and acceleration are computed from the last
    command. The safety filter and all generated motions stay within tighter limits: this check catches their defects.
    If limits contradict each other, position has priority over velocity, and velocity over acceleration. A joint that
    is outside its limits may stay there or come back. Binary grippers have no velocity limit. A stop may remove any
    velocity at once.
    """

    def __init__(self, limits: Limits, settings: SafetySettings) -> None:
        self._limits = limits
        self._reach = limits.radian_scale
        self._top = limits.velocity * _MARGIN
        hardest = max(settings.acceleration, settings.motion_acceleration, settings.brake_acceleration)
        self._rate = hardest * limits.radian_scale * _MARGIN
        self._speeds = np.zeros(len(limits.names), bool)
        self._speeds[list(limits.speeds)] = True

    def __call__(
        self, action: Float64, previous: Float64, velocity: Float64, elapsed: float, stop: bool
    ) -> LimitedCommand:
        """Limit `action` [D]; `previous` was sent `elapsed` seconds before and moved at `velocity`.

        `stop` is True for the commands of the e-stop.
        """
        requested = np.where(np.isfinite(action), action, previous)
        low, high = self._velocities(velocity, elapsed, stop)
        moved = previous + np.clip((requested - previous) / elapsed, low, high) * elapsed
        free = self._limits.binary
        if stop:
            free = free | (self._speeds & (np.abs(requested) <= np.abs(previous)))
        moved = np.where(free, requested, moved)
        lower, upper = self._limits.lower, self._limits.upper
        sent = np.clip(moved, np.minimum(lower, previous), np.maximum(upper, previous))
        changed = ~(np.abs(sent - action) <= _TOLERANCE * self._reach)
        if not changed.any():
            return LimitedCommand(action)
        return LimitedCommand(np.where(changed, sent, action), self._notes(action, sent, changed))

    def _velocities(self, velocity: Float64, elapsed: float, stop: bool) -> tuple[Float64, Float64]:
        gain = self._rate * elapsed
        low, high = velocity - gain, velocity + gain
        if stop:
            low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
        high = np.clip(high, -self._top, self._top)
        return np.minimum(np.maximum(low, -self._top), high), high

    def _notes(self, action: Float64, sent: Float64, changed: np.ndarray) -> tuple[str, ...]:
        names = self._limits.names
        return tuple(
            _LAST_CHECK(joint=names[i], wanted=action[i], sent=sent[i]) for i in np.flatnonzero(changed)
        )
