"""What control does tick by tick: keep silent, hold, follow the timeline, move, obey the e-stop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from runtime.motion import Motion
from runtime.recording.base import ControlSource
from runtime.safety import Path
from runtime.timeline import Makers, Timeline
from runtime.types import Float64


@dataclass(frozen=True, slots=True)
class Target:
    """What a behaviour wants sent for one tick: float64 [D], and how strictly it is to be judged.

    `path` None is a braking or held target, which is sent as it is: refusing it would leave nothing to send.
    """

    action: Float64
    source: ControlSource
    path: Path | None
    makers: Makers = ()


class Behaviour(ABC):
    """One way of filling ticks."""

    name: str
    moving = False  # whether the robot is meant to be in motion

    @abstractmethod
    def target(self, step: int, now: float) -> Target | None:
        """What to send for tick `step` planned at `now`; None where nothing is to be sent."""


class Silent(Behaviour):
    """Sends nothing: before the first set-up the robot is not ours."""

    name = "silent"

    def target(self, step: int, now: float) -> Target | None:
        return None


class Hold(Behaviour):
    """Comes to a stand and sends the held target on every tick: some nodes move when we fall silent."""

    name = "hold"

    def __init__(self, brake: Motion, started: float) -> None:
        self._brake = brake
        self._started = started

    def target(self, step: int, now: float) -> Target | None:
        return Target(self._brake.at(now - self._started), "hold", None)


class Move(Behaviour):
    """Runs a trajectory of ours."""

    name = "motion"
    moving = True

    def __init__(self, motion: Motion, started: float) -> None:
        self._motion = motion
        self._started = started

    def target(self, step: int, now: float) -> Target | None:
        return Target(self._motion.at(now - self._started), "motion", "motion")

    def finished(self, now: float) -> bool:
        return now - self._started >= self._motion.duration


class Follow(Behaviour):
    """Executes the timeline; None for a step that nothing is planned for."""

    name = "follow"
    moving = True

    def __init__(self, run: int, timeline: Timeline) -> None:
        self.run = run
        self.timeline = timeline

    def target(self, step: int, now: float) -> Target | None:
        planned = self.timeline.at(step)
        if planned is None:
            return None
        return Target(planned.action, "policy", "policy", planned.makers)


class EStopped(Behaviour):
    """Sends the measured position on every tick, or the last command where the measurement is old.

    `position` float64 [D] is renewed by the tick; None, nothing is sent, while it is not known.
    """

    name = "estop"

    def __init__(self, position: Float64 | None) -> None:
        self.position = position

    def target(self, step: int, now: float) -> Target | None:
        return None if self.position is None else Target(self.position, "estop", None)
