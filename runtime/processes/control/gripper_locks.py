"""Locks that hold grippers at a position, whatever is commanded."""

from __future__ import annotations

import numpy as np

from runtime.core.sentences import Pattern, fixed, series
from runtime.core.types import Float64
from runtime.safety.filter import Limits
from runtime.spaces.binary_grippers import BinaryGripper, snap_grippers

_LOCKS_OF_OTHER_SHAPE = Pattern(
    "control.locks_of_other_shape",
    "locks are {kind} {shape}; expected float {expected}",
)
_NO_GRIPPER = Pattern("control.no_gripper", "{joint} is no gripper: only grippers are locked")
_LOCKED_AT = Pattern("control.locked_at", "{joint} locked at {value:g}")
_GRIPPERS_FREE = fixed("control.grippers_free", "every gripper is free")

_SAME = 1e-9


class GripperLocks:
    """Locks of grippers, applied to an action after the plan and before safety."""

    def __init__(self, limits: Limits, switches: tuple[BinaryGripper, ...] = ()) -> None:
        self._limits = limits
        self._switches = switches
        self._notes: dict[int, str] = {}
        self.values: Float64 = np.full(len(limits.lower), np.nan)  # [D] locked positions, NaN if unlocked
        self.on = np.zeros(len(limits.lower), bool)  # [D]

    def set(self, values: Float64, commanded: Float64) -> str:
        """Lock grippers at `values` [D] within their limits; NaN unlocks a gripper.

        Return the reason if the locks are refused, else "". Binary grippers are locked open or closed, with hysteresis
        around `commanded` [D].
        """
        limits = self._limits
        if values.shape != limits.lower.shape or values.dtype.kind != "f":
            return _LOCKS_OF_OTHER_SHAPE(kind=values.dtype, shape=values.shape, expected=limits.lower.shape)
        wrong = np.flatnonzero(~np.isnan(values) & ~limits.grippers)
        if len(wrong):
            return _NO_GRIPPER(joint=limits.names[wrong[0]])
        within = np.clip(values.astype(np.float64), limits.lower, limits.upper)
        self.values = snap_grippers(self._switches, within, commanded)
        self.on = ~np.isnan(self.values)
        self._notes = {
            int(i): _LOCKED_AT(joint=limits.names[i], value=round(float(self.values[i]), 4))
            for i in np.flatnonzero(self.on)
        }
        return ""

    def apply(self, action: Float64) -> tuple[Float64, tuple[str, ...]]:
        """Return `action` [D] with locked dimensions replaced, and a note for each lock that changed a value."""
        if not self._notes or action.shape != self.values.shape:
            return action, ()
        replaced = np.where(self.on, self.values, action)
        return replaced, tuple(
            note for i, note in self._notes.items() if not abs(replaced[i] - action[i]) <= _SAME
        )

    def __str__(self) -> str:
        return series(list(self._notes.values()), ",") or _GRIPPERS_FREE
