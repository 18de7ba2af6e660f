"""What makes control hold although nobody told it to: a family that is silent, an arm that was moved."""

from __future__ import annotations

import numpy as np

from runtime.actuator import RobotActuator, TickSettings
from runtime.page import Page
from runtime.plausibility import Plausibility
from runtime.seen import Seen
from runtime.types import Float64

_RETURNED_AWAY = 0.1  # [rad] that an arm may be off after it was not seen, by sagging


def silent_sibling(page: Page, now: float, allowed: float) -> str:
    """The process whose heartbeat is older than `allowed` seconds, in a sentence; "" where none is."""
    for process in ("main", "guard"):
        if not page.alive(process, now, allowed):
            return f"no sign of life from {process} {page.silence(process, now)}"
    return ""


class Displacement:
    """Notices a robot that is far from where it is told to hold.

    It was moved by hand, switched off, or its node was restarted: to send the old target would make it move by
    itself. One sample says nothing: it is there when several agree (`Plausibility.apart`).
    """

    def __init__(self, settings: TickSettings, plausibility: Plausibility) -> None:
        self._settings = settings
        self._plausibility = plausibility
        self._angles = settings.limits.places

    def __call__(self, robot: RobotActuator, seen: Seen, now: float, held: bool) -> Float64 | None:
        """Where the robot is [D], where that is too far from where it is `held`; None where all is well."""
        measured = robot.measured(seen, now)
        if measured is None:
            return None
        returned = self._plausibility.returned()
        if not held or self._settings.safety.report_only:
            return None
        allowed = _RETURNED_AWAY if returned else self._settings.safety.following_error
        if self.distance(robot, measured) <= allowed:
            return None
        return measured if self._plausibility.apart(robot.commanded, allowed) else None

    def distance(self, robot: RobotActuator, measured: Float64) -> float:
        """How far the farthest joint is from its command [rad]."""
        return float(np.abs(measured - robot.commanded).max(where=self._angles, initial=0.0))
