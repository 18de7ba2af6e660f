"""Actuators: last command of a robot, its velocity, and braking."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from runtime.config.schema import FaultResponse
from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed, series
from runtime.core.types import ControlSource, Float32, Float64, RobotCommand
from runtime.ipc.observation_reader import LatestObservation
from runtime.ipc.shared_state import EStop, SharedState
from runtime.motion.timeline import DimensionKinds, difference
from runtime.motion.trajectories import Brake
from runtime.processes.control.behaviours import Target
from runtime.processes.control.node_peers import END
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
    heartbeat_timeout: Callable[[str], float]  # timeout of a process, by name
    starvation: FaultResponse
    starvation_hold: float  # until "slow" holds
    moves_robot: bool = True  # commands reach hardware that can break
    switches: tuple[BinaryGripper, ...] = ()
    publication: Callable[[Float64], Float32] | None = None  # poses of a joint command, if published

    @property
    def checks_measurements(self) -> bool:
        """Whether measurements are checked for plausibility, and commands by the command limiter."""
        return self.moves_robot and not self.safety.report_only

    @property
    def starvation_patience(self) -> float:
        """Longest time that a run continues without a planned action [s]."""
        return self.starvation_hold if self.starvation == "slow" else 0.0


class TickResult(NamedTuple):
    """Result of one tick.

    `target` is the target of the behaviour; it is None if the behaviour had none. `executed` float64 [D] is the action
    that was sent; it is None if nothing was sent.
    """

    time: float  # our monotonic clock [s]
    target: Target | None = None
    executed: Float64 | None = None
    notes: tuple[str, ...] = ()
    refused: bool = False
    limited: str = ""  # joint that safety changed most, "" if it changed nothing
    change: float = 0.0  # by how much [rad, or a gripper's equivalent]
    near: Collision | None = None  # links that it brings near each other, if only warned of
    corrected: str = ""  # changes by the command limiter


class Actuator(ABC):
    """Robot with its last command, which is known only while the robot is engaged."""

    def __init__(self, settings: TickSettings) -> None:
        dim = len(settings.limits.lower)
        self._settings = settings
        self._reach = settings.limits.radian_scale
        self._switching = bool(settings.limits.binary.any())
        self._last_planned: float | None = None
        self._stepped: tuple[str, ...] = ()  # why the next command does not continue the last one
        self.engaged = False
        self.commanded: Float64 = np.zeros(dim)
        self.velocity: Float64 = np.zeros(dim)  # mean of the last tick
        self._ends: Float64 | None = None  # velocity at the end of the tick, if it differs

    @abstractmethod
    def state(self, seen: LatestObservation, planned: float, aim: Float64 | None) -> RobotState:
        """Return the robot's state at time `planned`, against which safety checks an action.

        `aim` is the action that was requested at the previous tick.
        """

    @abstractmethod
    def _deliver(self, step: int, action: Float64, source: ControlSource) -> float:
        """Send `action`, which is of this source, to the robot; return the time at which it was sent."""

    def engage(self, measured: Float64) -> None:
        """Engage the robot at its measured position: from now on a command is sent on every tick.

        Grippers of an engaged robot keep their command: if they hold an object, the measured opening is wider than
        the command, and they would drop it. A mobile base gets speed 0.
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
        """Disengage the robot: nothing is sent, and its commanded position is unknown."""
        self.engaged = False

    def zero_velocity(self) -> None:
        """Set the velocity of the last command to zero."""
        self.velocity, self._ends = np.zeros(len(self.commanded)), None

    def snap_grippers(self) -> None:
        """Snap the command of each binary gripper to open or closed.

        The robot may have been engaged with a command between open and closed.
        """
        self.commanded = snap_grippers(self._settings.switches, self.commanded, self.commanded)

    def rebase_command(self, measured: Float64, why: str, farthest: Float64 | float = np.inf) -> None:
        """Restart the command at `measured`, but move each joint by at most `farthest` [D].

        No other method lets the command jump. The jump is towards the measured position, so that it does not pull the
        robot. The tick record contains `why`, the reason.
        """
        before = self.commanded
        self.engage(before + np.clip(measured - before, -np.asarray(farthest), farthest))
        self._note_step(before, self.commanded, why)

    def _note_step(self, before: Float64, after: Float64, cause: str) -> None:
        apart = np.where(self._settings.limits.position_mask, np.abs(after - before), 0.0)
        if apart.any():
            worst = int(apart.argmax())
            self._stepped = (
                _STEPPED(why=cause, joint=self._settings.limits.names[worst], distance=apart[worst]),
            )

    @property
    def stopping_distance(self) -> Float64:
        """Distance that each joint needs to stop from its commanded speed [D]."""
        limits, safety = self._settings.limits, self._settings.safety
        return np.asarray(self.velocity**2 / (2.0 * safety.brake_acceleration * limits.radian_scale))

    def elapsed(self, planned: float) -> float:
        """Return the time since the last tick [s], clipped to 0.5 to 1.5 periods, for use in limits.

        `planned` is the planned time of the present tick [s].
        """
        period = self._settings.period
        since = period if self._last_planned is None else planned - self._last_planned
        return min(max(since, period * 0.5), 1.5 * period)

    def end_tick(self, planned: float) -> None:
        """Record that the tick planned for `planned` has ended, whether it sent a command or not."""
        self._last_planned = planned

    def braking_motion(self) -> Brake:
        """Return a braking motion from the last commanded velocity, within the joint limits."""
        velocity = self.velocity if self._ends is None else self._ends
        return braking(self.commanded, velocity, self._settings.limits, self._settings.safety)

    def send(
        self, step: int, planned: float, target: Target, action: Float64, notes: tuple[str, ...] = ()
    ) -> TickResult:
        """Send `action` at tick `step`, planned for time `planned`; return the result of the tick.

        `action` [D] is the behaviour's `target` after the gripper locks and the safety filter; `notes` are their
        remarks on changes, and are copied to the result. If the e-stop was pressed since the beginning of the tick, the
        last command is sent again instead.
        """
        elapsed = self.elapsed(planned)
        stop = target.source == "estop"
        if self._estop_pressed and not stop:
            # Pressed after this tick's check: repeat the last command, the next tick enters the e-stop
            # behaviour.
            action, notes, stop = (
                self._settings.limits.with_zero_speeds(self.commanded),
                (_PRESSED_WITHIN_TICK,),
                True,
            )
        action, corrected = self._checked(action, elapsed, stop)
        time = self._deliver(step, action, "estop" if stop else target.source)
        self.velocity = (action - self.commanded) / elapsed
        if self._switching:
            self.velocity[self._settings.limits.binary] = 0.0
        self._ends = None
        if target.velocity is not None:  # braking from the mean would take longer than checked
            self._ends = np.where(action == target.action, target.velocity, self.velocity)
        self.commanded = action
        notes, self._stepped = (*self._stepped, *notes, *corrected), ()
        return TickResult(time, target, action, notes, corrected=series(corrected))

    @property
    def _estop_pressed(self) -> bool:
        """Whether the e-stop is pressed."""
        return False

    def _checked(self, action: Float64, elapsed: float, stop: bool) -> LimitedCommand:
        """Return `action` unchanged; subclasses with a measured robot check it against the measurements."""
        return LimitedCommand(action)


class RobotActuator(Actuator):
    """Actuator of the real robot, which sends commands through a transport.

    A restarted control process continues at rest from the last command of its predecessor.
    """

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
        """Return the measured joint positions [D]; None if they are unknown, implausible or old."""
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

    def _unwrapped_joints(self, observation: LatestObservation) -> Float64:
        """Return the measured joints [D]; wrapping angles are shifted by whole turns to be nearest to the last command.

        The shift is necessary because some nodes do not count turns.
        """
        wrapping = self._settings.dims.wrapping
        if not wrapping or not self.engaged:
            return observation.joints
        return self.commanded + difference(observation.joints, self.commanded, wrapping)

    def send_node_request(self, word: str, data: Mapping[str, Any]) -> str:
        """Send the control word `word` to the node; return the reason if it was not sent, "" if it was.

        Unless the e-stop is clear, only END is sent, the word that ends node-driven mode.
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

    def _deliver(self, step: int, action: Float64, source: ControlSource) -> float:
        now = self._clock()
        eef = None if self._settings.publication is None else self._settings.publication(action)
        self._sink.send(RobotCommand(action.astype(np.float32), step, now, eef, source))
        return now


class SimulatedActuator(Actuator):
    """Simulated robot that reaches each command at once; without a transport, nothing is sent."""

    def __init__(self, start: Float64, settings: TickSettings, clock: Callable[[], float]) -> None:
        super().__init__(settings)
        self._clock = clock
        self.engage(start)
        self.snap_grippers()

    def state(self, seen: LatestObservation, planned: float, aim: Float64 | None) -> RobotState:
        # Its joints are known at once; pictures come from outside and age as for the real robot.
        return RobotState(
            previous=self.commanded,
            velocity=self.velocity,
            measured=self.commanded,
            elapsed=self.elapsed(planned),
            picture_ages=seen.picture_ages(planned),
            previous_target=aim,
        )

    def _deliver(self, step: int, action: Float64, source: ControlSource) -> float:
        return self._clock()
