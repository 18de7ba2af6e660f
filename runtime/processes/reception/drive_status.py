"""Drive state that a robot's node reports, frame by frame, and what is worth a line in the event log."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from runtime.core.sentences import Pattern, fixed, series

_ENABLED = fixed("drives.enabled", "drives enabled")
_DISABLED = fixed("drives.disabled", "drives disabled")
_FAULT = Pattern("drives.fault", "drive fault: {fault}")
_FAULT_GONE = Pattern("drives.fault_gone", "drive fault gone: {fault}")

_QUIET_S = 0.2  # between two lines: a node that says something else in every frame floods no log


class DriveStatus:
    """The newest state that was said: {"enabled": bool, "faults": [str]}, {} while the node does not say."""

    def __init__(self) -> None:
        self.newest: Mapping[str, Any] = {}
        self._enabled = True  # what is as it should be needs no line
        self._faults: tuple[str, ...] = ()
        self._told = -math.inf

    def update(self, said: Mapping[str, Any] | None, now: float) -> str:
        """Take what one observation says; returns a sentence of what has changed since the last one, or "".

        An observation that does not say is no change: one whose drive state could not be read is none either. A
        change within 0.2 s of the last sentence is told after it, if it is still there.
        """
        self.newest = said or {}
        if said is None or now - self._told < _QUIET_S:
            return ""
        enabled, faults = bool(said["enabled"]), tuple(said["faults"])
        changes: list[str] = [] if enabled == self._enabled else [_ENABLED if enabled else _DISABLED]
        changes += [_FAULT(fault=fault) for fault in faults if fault not in self._faults]
        changes += [_FAULT_GONE(fault=fault) for fault in self._faults if fault not in faults]
        self._enabled, self._faults = enabled, faults
        if changes:
            self._told = now
        return series(changes)
