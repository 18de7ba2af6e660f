"""Actuators: the last command that a robot was told, how fast that moved, how it comes to a stand."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from runtime.config.schema import FaultResponse
from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed, series
from runtime.core.types import Float32, Float64, RobotCommand
from runtime.ipc.observation_reader import LatestObservation
from runtime.ipc.shared_state import EStop, SharedState
from runtime.motion.timeline import DimensionKinds, difference
from runtime.motion.trajectories import Brake
from runtime.processes.control.behaviours import Target
from runtime.processes.control.node_handover import END
from runtime.safety.collision import Collision
from runtime.safety.filter import Limits, RobotState, SafetySettings, braking
from runtime.safety.limiter import CommandLimiter, LimitedCommand
from runtime.spaces.binary_grippers import BinaryGripper, snap_grippers
from runtime.transports.base import Sink

_TAKEN_OVER = fixed("control.taken_over", "taken over inside its limits")
_STEPPED = Pattern("control.stepped", "{why}: {joint} stepped {distance:.3f} rad")
_PRESSED_WITHIN_TICK = fixed("control.pressed_within_tick", "e-stop pressed within the tick")
_NOT_PASSED_ON = Pattern(
    "control.not_passed_on",
    "{word} is not passed on to the node while the e-stop is not known to be clear",
)


@dataclass(frozen=True, slots=True)
class TickSettings:
    """Settings of a tick; times in seconds."""

    period: float
    limits: Limits
    dims: DimensionKinds
    safety: SafetySettings
    heartbeat_timeout: Callable[[str], float]  # silence after which the process of that name counts as gone
    starvation: FaultResponse
    starvation_hold: float  # until "slow" holds
    moves_robot: bool = True  # commands reach something that can break
    switches: tuple[BinaryGripper, ...] = ()
    publication: Callable[[Float64], Float32] | None = (
        None  # poses of a joint command, where they are published too
    )

    @property
    def checks_measurements(self) -> bool:
        """True if measurements are doubted, and commands checked once more where they leave."""
        return self.moves_robot and not self.safety.report_only

    @property
    def starvation_patience(self) -> float:
        """Time that a run may go on with nothing planned [s]."""
        return self.starvation_hold if self.starvation == "slow" else 0.0


class TickResult(NamedTuple):
    """Result of one tick: its target, and float64 [D] of what left, None where nothing did."""

    time: float  # our monotonic clock [s]
    target: Target | None = None
    executed: Float64 | None = None
    notes: tuple[str, ...] = ()
    refused: bool = False
    limited: str = ""  # the joint that safety changed most, "" where it changed nothing
    change: float = 0.0  # by how much [rad, or what a gripper's travel is worth]
    near: Collision | None = None  # links that it brought near each other, where that is only warned of
    corrected: str = ""  # what the last check changed


class Actuator(ABC):
    """A robot as it was last told; only an engaged one knows where it was told to be."""

    def __init__(self, settings: TickSettings) -> None:
        dim = len(settings.limits.lower)
        self._settings = settings
        self._reach = settings.limits.radian_scale
        self._switching = bool(settings.limits.binary.any())
        self._last_planned: float | None = None
        self._stepped: tuple[str, ...] = ()  # why the next command begins elsewhere than the last one ended
        self.engaged = False
        self.commanded: Float64 = np.zeros(dim)
        self.velocity: Float64 = np.zeros(dim)  # mean, of the last tick
        self._ends: Float64 | None = None  # at its end, where that is another

    @abstractmethod
    def state(self, seen: LatestObservation, planned: float, aim: Float64 | None) -> RobotState:
        """State that an action is judged against; `aim` is the action that was wanted before it."""

    @abstractmethod
    def _deliver(self, step: int, action: Float64) -> float:
        """Tell the robot; when that was."""

    def engage(self, measured: Float64) -> None:
        """Take the robot over where it stands: from now on something is sent on every tick.

        The grippers of a robot that was engaged before keep their command: closing on an object, they measure
        wider than they were told, and would let go. A base stands.
        """
        limits = self._settings.limits
        measured = limits.with_zero_speeds(np.where(limits.grippers & self.engaged, self.commanded, measured))
        inside = (
            np.clip(measured, limits.lower, limits.upper) if self._settings.checks_measurements else measured
        )
        self._note_step(measured, inside, _TAKEN_OVER)
        self.commanded = inside
        self.zero_velocity()
        self.engaged = True

    def disengage(self) -> None:
        """Leave the robot alone: nothing is sent, and where it is told to be is not known any more."""
        self.engaged = False

    def zero_velocity(self) -> None:
        """Count the last command as one at rest."""
        self.velocity, self._ends = np.zeros(len(self.commanded)), None

    def snap_grippers(self) -> None:
        """Count binary grippers as told open or closed, although they were taken over in between."""
        self.commanded = snap_grippers(self._settings.switches, self.commanded, self.commanded)

    def rebase_command(self, measured: Float64, why: str, farthest: Float64 | float = np.inf) -> None:
        """Count from where the robot is, and not from where it was told to be, at most `farthest` [D] from there.

        The only way in which a command may step: towards the robot, so that nothing pulls it. The record says `why`.
        """
        before = self.commanded
        self.engage(before + np.clip(measured - before, -np.asarray(farthest), farthest))
        self._note_step(before, self.commanded, why)

    def _note_step(self, before: Float64, after: Float64, why: str) -> None:
        apart = np.where(self._settings.limits.position_mask, np.abs(after - before), 0.0)
        if apart.any():
            worst = int(apart.argmax())
            self._stepped = (
                _STEPPED(why=why, joint=self._settings.limits.names[worst], distance=apart[worst]),
            )

    @property
    def stopping_distance(self) -> Float64:
        """The distance within which each joint can come to rest from the speed of its command [D]."""
        limits, safety = self._settings.limits, self._settings.safety
        return np.asarray(self.velocity**2 / (2.0 * safety.brake_acceleration * limits.radian_scale))

    def elapsed(self, planned: float) -> float:
        """Time since the last tick as limits may use it: half a period to 1.5 periods."""
        period = self._settings.period
        since = period if self._last_planned is None else planned - self._last_planned
        return min(max(since, period * 0.5), 1.5 * period)

    def end_tick(self, planned: float) -> None:
        """The tick planned for `planned` is over, whether it sent anything or not."""
        self._last_planned = planned

    def braking_motion(self) -> Brake:
        """A stop from the last commanded velocity, as hard as needed to stay within the joint limits."""
        velocity = self.velocity if self._ends is None else self._ends
        return braking(self.commanded, velocity, self._settings.limits, self._settings.safety)

    def send(
        self, step: int, planned: float, target: Target, action: Float64, notes: tuple[str, ...] = ()
    ) -> TickResult:
        """Tell the robot `action`, which is what locks and safety made of `target`."""
        elapsed = self.elapsed(planned)
        stop = target.source == "estop"
        if self._estop_pressed and not stop:
            # Since this tick looked: the next one takes over, this one repeats the last command.
            action, notes, stop = (
                self._settings.limits.with_zero_speeds(self.commanded),
                (_PRESSED_WITHIN_TICK,),
                True,
            )
        action, corrected = self._checked(action, elapsed, stop)
        time = self._deliver(step, action)
        self.velocity = (action - self.commanded) / elapsed
        if self._switching:
            self.velocity[self._settings.limits.binary] = 0.0
        self._ends = None
        if target.velocity is not None:  # to brake anew from the mean would brake farther than was looked at
            self._ends = np.where(action == target.action, target.velocity, self.velocity)
        self.commanded = action
        notes, self._stepped = (*self._stepped, *notes, *corrected), ()
        return TickResult(time, target, action, notes, corrected=series(corrected))

    @property
    def _estop_pressed(self) -> bool:
        """True if the e-stop is pressed."""
        return False

    def _checked(self, action: Float64, elapsed: float, stop: bool) -> LimitedCommand:
        """The part of `action` that may be sent."""
        return LimitedCommand(action)


class RobotActuator(Actuator):
    """The robot itself, behind a transport. A restarted control goes on from the last command, at rest."""

    def __init__(
        self, shared: SharedState, sink: Sink, settings: TickSettings, clock: Callable[[], float]
    ) -> None:
        super().__init__(settings)
        self._shared_state = shared
        self._sink = sink
        self._clock = clock
        self._limiter = (
            CommandLimiter(settings.limits, settings.safety) if settings.checks_measurements else None
        )
        before = shared.control.read()
        self.engaged = bool(before["engaged"])
        self.commanded = np.array(before["commanded"], np.float64)

    def measured(self, seen: LatestObservation, now: float) -> Float64 | None:
        """Measured joint positions [D]; None if they are unknown, doubted or old."""
        return self._unwrapped_joints(seen) if seen.is_fresh(now, self._settings.safety.joint_age_s) else None

    def state(self, seen: LatestObservation, planned: float, aim: Float64 | None) -> RobotState:
        return RobotState(
            previous=self.commanded,
            velocity=self.velocity,
            measured=self._unwrapped_joints(seen),
            elapsed=self.elapsed(planned),
            joint_age=planned - seen.joints_captured,
            implausible_reason=seen.implausible_reason,
            picture_ages=seen.picture_ages(planned),
            previous_target=aim,
        )

    def _unwrapped_joints(self, seen: LatestObservation) -> Float64:
        """The joints, angles that wrap counted in the turn of the last command, as the node may not count them."""
        wrapping = self._settings.dims.wrapping
        if not wrapping or not self.engaged:
            return seen.joints
        return self.commanded + difference(seen.joints, self.commanded, wrapping)

    def send_node_request(self, word: str, data: Mapping[str, Any]) -> str:
        """Pass a control word on to the node; why it was not, "" where it was.

        While the e-stop is pressed only the word that ends what the node does by itself is.
        """
        if self._shared_state.estop is not EStop.CLEAR and word != END:
            return _NOT_PASSED_ON(word=word)
        try:
            self._sink.send_control_word(word, data)
        except RuntimeFault as error:
            return str(error)
        return ""

    @property
    def _estop_pressed(self) -> bool:
        return self._shared_state.estop is EStop.LATCHED

    def _checked(self, action: Float64, elapsed: float, stop: bool) -> LimitedCommand:
        if self._limiter is None:
            return LimitedCommand(action)
        return self._limiter(action, self.commanded, self.velocity, elapsed, stop)

    def _deliver(self, step: int, action: Float64) -> float:
        now = self._clock()
        eef = None if self._settings.publication is None else self._settings.publication(action)
        self._sink.send(RobotCommand(action.astype(np.float32), step, now, eef))
        return now


class SimulatedActuator(Actuator):
    """A robot that is at once where it is told to be. It knows of no transport: nothing of it is ever sent."""

    def __init__(self, start: Float64, settings: TickSettings, clock: Callable[[], float]) -> None:
        super().__init__(settings)
        self._clock = clock
        self.engage(start)
        self.snap_grippers()

    def state(self, seen: LatestObservation, planned: float, aim: Float64 | None) -> RobotState:
        # Its joints are known at once; pictures come from outside and grow old as they do for the real robot.
        return RobotState(
            previous=self.commanded,
            velocity=self.velocity,
            measured=self.commanded,
            elapsed=self.elapsed(planned),
            picture_ages=seen.picture_ages(planned),
            previous_target=aim,
        )

    def _deliver(self, step: int, action: Float64) -> float:
        return self._clock()
