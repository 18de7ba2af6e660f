"""Behaviours of a robot that follows no plan, tick by tick: keep silent, hold, move, obey the e-stop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from runtime.core.types import Float64
from runtime.motion.timeline import Contributions
from runtime.motion.trajectories import Brake, Motion
from runtime.recording.base import ControlSource
from runtime.safety.filter import Path


class Target(NamedTuple):
    """Target of a behaviour for one tick: float64 [D], and how strictly it is to be judged.

    `path` None is a braking or held target, which is sent as it is: refusing it would leave nothing to send.
    """

    action: Float64
    source: ControlSource
    path: Path | None
    contributions: Contributions = ()
    velocity: Float64 | None = None  # at the end of the tick, where it is not that on the way there


class Behaviour(ABC):
    """One way of filling ticks."""

    name: str
    moving = False  # whether the robot is meant to be in motion

    @abstractmethod
    def target(self, step: int, elapsed: float) -> Target | None:
        """Target of tick `step`, `elapsed` seconds after the one before; None where nothing is to be sent.

        `elapsed` is what limits may use: after a stall a motion goes on where it was, it does not catch up.
        """


class Disengaged(Behaviour):
    """Sends nothing: before the first set-up the robot is not ours."""

    name = "silent"

    def target(self, step: int, elapsed: float) -> Target | None:
        return None


class NodeDriven(Behaviour):
    """Sends nothing because the node drives the robot by its own leader; whatever stops us takes that back."""

    name = "yield"
    moving = True

    def target(self, step: int, elapsed: float) -> Target | None:
        return None


class Hold(Behaviour):
    """Comes to a stand and sends the held target on every tick: some nodes move when we fall silent."""

    name = "hold"

    def __init__(self, brake: Brake) -> None:
        self._brake = brake
        self._time = 0.0

    @property
    def at_rest(self) -> bool:
        """True if it has come to a stand."""
        return self._time >= self._brake.duration

    def target(self, step: int, elapsed: float) -> Target:
        self._time += elapsed
        return Target(self._brake.at(self._time), "hold", None, velocity=self._brake.velocity(self._time))


class MoveTo(Behaviour):
    """Comes to a stand, then runs a trajectory of ours; its time goes on only with what was sent.

    `speed` is the part of the speed of such motions that it was planned with.
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
        """The newest target was sent, and not refused."""
        self._time = self._next

    @property
    def finished(self) -> bool:
        return self._time >= self._brake.duration + self._motion.duration


class EStopHold(Behaviour):
    """Sends where the robot comes to rest, or the last command where that is not known.

    Joints that stood within their steady error keep their command. The others go along with the measurement for
    `_FOLLOWS_S`, while the arm comes to rest, as far beside it as they last stood from their command and no farther
    from where they were first seen than coming to rest takes, and then keep that: an arm that is sent its own
    measurement sinks under its weight. `position` float64 [D], None before the robot was ever measured: nothing is
    sent then. `rest` [D]: the distance within which it could come to rest.
    """

    name = "estop"
    _FOLLOWS_S = 0.5
    _SLACK = 0.05  # [rad] beyond the distance to rest: what a command is ahead of a robot that follows it

    def __init__(self, position: Float64 | None, rest: Float64, captured: float = float("-inf")) -> None:
        """`captured`: the newest sample of the joints when it was pressed [s]."""
        self.position = position
        self.rest = rest
        self.captured = captured
        self.kept: np.ndarray | None = None  # joints that keep their command, bool [D]; None until it is seen
        self._first: Float64 | None = None  # where it was seen first since it was pressed
        self._time = 0.0

    @property
    def was_measured(self) -> bool:
        """True if the robot was seen since the e-stop was pressed."""
        return self._first is not None

    def update_measured(self, position: Float64) -> None:
        """Take the measured position of a robot that comes to rest, no farther than it could go."""
        self._first = position if self._first is None else self._first
        farthest = self.rest + self._SLACK
        self.position = np.clip(position, self._first - farthest, self._first + farthest)

    def hold_at(self, position: Float64) -> None:
        """Hold the robot at `position` from now on."""
        self._first = self.position = position

    def release(self) -> None:
        """Nothing is sent until it is measured anew."""
        self.position = None

    @property
    def is_settling(self) -> bool:
        """True while the arm may still be coming to rest."""
        return self._time <= self._FOLLOWS_S

    def target(self, step: int, elapsed: float) -> Target | None:
        self._time += elapsed
        return None if self.position is None else Target(self.position, "estop", None)
