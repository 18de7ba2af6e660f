"""Behaviours without a plan: disengaged, node-driven, hold, move, e-stop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from runtime.core.types import ControlSource, Float64
from runtime.motion.timeline import Contributions
from runtime.motion.trajectories import Brake, Motion
from runtime.safety.filter import Path


class Target(NamedTuple):
    """Target of a behaviour for one tick: `action` float64 [D].

    `path` selects the safety limits that apply to it. If `path` is None, the target is part of braking or holding.
    Safety does not check such a target, because after a refusal there would be nothing to send.
    """

    action: Float64
    source: ControlSource
    path: Path | None
    contributions: Contributions = ()
    velocity: Float64 | None = None  # at the end of the tick, if it differs from the mean


class Behaviour(ABC):
    """Source of targets, one per tick."""

    name: str
    moving = False  # whether the robot should be in motion

    @abstractmethod
    def target(self, step: int, elapsed: float) -> Target | None:
        """Return the target of tick `step`, `elapsed` seconds after its predecessor; None if nothing is sent.

        `elapsed` is clipped for limits: after a stall a motion continues where it was, and does not catch up.
        """


class Disengaged(Behaviour):
    """Behaviour that sends nothing: before the first set-up the robot is not under our control."""

    name = "silent"

    def target(self, step: int, elapsed: float) -> Target | None:
        return None


class NodeDriven(Behaviour):
    """Behaviour that sends nothing, because the node's own leader drives the robot; any stop ends it."""

    name = "yield"
    moving = True

    def target(self, step: int, elapsed: float) -> Target | None:
        return None


class Hold(Behaviour):
    """Behaviour that brakes and then sends the held target on every tick: some nodes move if commands stop."""

    name = "hold"

    def __init__(self, brake: Brake) -> None:
        self._brake = brake
        self._time = 0.0

    @property
    def at_rest(self) -> bool:
        """Whether braking has ended."""
        return self._time >= self._brake.duration

    def target(self, step: int, elapsed: float) -> Target:
        self._time += elapsed
        return Target(self._brake.at(self._time), "hold", None, velocity=self._brake.velocity(self._time))


class MoveTo(Behaviour):
    """Behaviour that brakes, then executes a generated trajectory; its time advances only when a command is sent.

    `speed` is the share of the speed of generated motions with which the trajectory was planned.
    """

    name = "motion"
    moving = True

    def __init__(self, brake: Brake, motion: Motion, goal: Float64, speed: float) -> None:
        self.goal = goal
        self.speed = speed
        self._brake = brake
        self._motion = motion
        self._time = self._next = 0.0

    def target(self, step: int, elapsed: float) -> Target | None:
        self._next = self._time + elapsed
        if self._next < self._brake.duration:
            velocity = self._brake.velocity(self._next)
            return Target(self._brake.at(self._next), "motion", None, velocity=velocity)
        return Target(self._motion.at(self._next - self._brake.duration), "motion", "motion")

    def advance(self) -> None:
        """Record that the newest target was sent and not refused."""
        self._time = self._next

    @property
    def finished(self) -> bool:
        return self._time >= self._brake.duration + self._motion.duration


class EStopHold(Behaviour):
    """Behaviour that sends the position at which the robot comes to rest, or the last command if that is unknown.

    Joints with a steady servo error keep their command. For all other joints, the command follows the measurement for
    `_FOLLOWS_S`, while the arm comes to rest: it is the measured position plus the joint's last steady error, and stays
    within the stopping distance of the first measurement. After `_FOLLOWS_S` the command is constant, because an arm
    that is always sent its own measured position sinks under its weight.

    `position` float64 [D] is the position to send; if it is None, because the robot was never measured, nothing is
    sent. `rest` [D] is the stopping distance.
    """

    name = "estop"
    _FOLLOWS_S = 0.5
    _SLACK = 0.05  # [rad] added to the stopping distance: lead of a command over the robot that follows it

    def __init__(self, position: Float64 | None, rest: Float64, captured: float = float("-inf")) -> None:
        """Begin to hold.

        Args:
            position: Position to send [D], or None.
            rest: Stopping distance [D].
            captured: Capture time of the newest joints when the e-stop was pressed [s].
        """
        self.position = position
        self.rest = rest
        self.captured = captured
        self.kept: np.ndarray | None = None  # joints that keep their command, bool [D]; None until measured
        self._first: Float64 | None = None  # first measurement after the press
        self._time = 0.0

    @property
    def was_measured(self) -> bool:
        """Whether the robot was measured after the e-stop was pressed."""
        return self._first is not None

    def update_measured(self, position: Float64) -> None:
        """Set the position to the measurement of a robot that comes to rest, within its stopping distance."""
        self._first = position if self._first is None else self._first
        farthest = self.rest + self._SLACK
        self.position = np.clip(position, self._first - farthest, self._first + farthest)

    def hold_at(self, position: Float64) -> None:
        """Hold the robot at `position` from now on."""
        self._first = self.position = position

    def release(self) -> None:
        """Send nothing until the robot is measured again."""
        self.position = None

    @property
    def is_settling(self) -> bool:
        """Whether the arm may still be coming to rest."""
        return self._time <= self._FOLLOWS_S

    def target(self, step: int, elapsed: float) -> Target | None:
        self._time += elapsed
        return None if self.position is None else Target(self.position, "estop", None)
