"""Drive state that a robot's node reports with each frame, and the changes that are worth an event."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from runtime.core.sentences import Pattern, fixed, series

_ENABLED = fixed("drives.enabled", "drives enabled")
_DISABLED = fixed("drives.disabled", "drives disabled")
_FAULT = Pattern("drives.fault", "drive fault: {fault}")
_FAULT_GONE = Pattern("drives.fault_gone", "drive fault gone: {fault}")

_QUIET_S = 0.2  # shortest time between two events [s]: a node whose state flickers must not flood the log


class DriveStatus:
    """Newest reported drive state: {"enabled": bool, "faults": [str]}, {} if the node reports none."""

    def __init__(self) -> None:
        self.newest: Mapping[str, Any] = {}
        self._enabled = True  # enabled drives are normal and need no event
        self._faults: tuple[str, ...] = ()
        self._told = -math.inf

    def update(self, said: Mapping[str, Any] | None, now: float) -> str:
        """Store the drive state `said` of one observation; return a sentence about its changes, "" if there are none.

        An observation without a drive state does not count as a change, because its state may have been unreadable. A
        change within 0.2 s of the last sentence is reported later, if it persists.
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
