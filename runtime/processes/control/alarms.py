"""Alarms at which control holds without an order: a sibling process that is silent, an arm that was moved."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.ipc.observation_reader import LatestObservation
from runtime.ipc.shared_state import SharedState
from runtime.processes.control.actuator import RobotActuator, TickSettings
from runtime.processes.control.led import Led
from runtime.processes.control.plausibility import Plausibility

_SIBLING_SILENT = Pattern("control.sibling_silent", "no sign of life from {process} {since}")
_HELD_ELSEWHERE = Pattern(
    "control.held_elsewhere",
    "{joint} reads {measured:.3f} rad and is held at {held:.3f}: look whether the robot stands as it is"
    " shown, then set up again",
)

_RETURNED_AWAY = 0.1  # [rad] that an arm may be off after it was not seen, by sagging
_AGREES_S = 1.0  # that a joint reads where it is told to be, before its readings lead its command again
_NOISE = 0.02  # [rad] beyond a servo error that is set
_THERE = 1e-6  # [rad]
_LATELY_S = 1.0  # ago a command that moved went away from a joint that was blocked, and not the joint from it


def silent_sibling(shared: SharedState, now: float, allowed: Callable[[str], float]) -> str:
    """The process whose heartbeat is older than it is `allowed` to be [s], in a sentence; "" where none is."""
    for process in ("coordinator", "guard"):
        if not shared.alive(process, now, allowed(process)):
            return _SIBLING_SILENT(process=process, since=shared.silence(process, now))
    return ""


class Displacement:
    """Notices a robot that is far from where it is told to hold, and leads what is held to where it is.

    It was moved by hand, switched off, or its node was restarted: to send the old target would make it move by
    itself, and so would what moved it before it was not seen for a time. One sample says nothing: it is there when
    several agree (`Plausibility.apart`).

    An encoder that is off looks like that, but its joint follows the command, and its readings keep their distance. So
    no command follows a joint that leapt before the two have agreed for _AGREES_S, nor one a second time that has kept
    its distance: that one is followed again after a set-up, for the operator to look.
    """

    def __init__(self, settings: TickSettings, plausibility: Plausibility) -> None:
        self._settings = settings
        self._plausibility = plausibility
        self._angles = settings.limits.places
        dim = len(settings.limits.names)
        self._followed = np.zeros(dim, bool)  # their command was led to where they were read
        self._off = np.zeros(dim, bool)  # they were somewhere else again then
        self._apart_at = np.full(dim, float("-inf"))  # when each was last read away from its command
        self._meeting = False  # a set-up takes the robot over where it is read, and not yet there
        self.goal: Float64 | None = None  # where the command is being led to
        self._led: Led | None = None  # how far, while it is
        self._free_at = float("-inf")  # when the command was last free to move
        self.begins = False  # whether it has been since this tick
        self._doubt = ""  # which joints are not followed since this tick, and why

    def take_doubt(self) -> str:
        """The joints that are not followed since it was asked last, and why; "" for none."""
        doubt, self._doubt = self._doubt, ""
        return doubt

    def __call__(
        self, robot: RobotActuator, seen: LatestObservation, now: float, held: bool
    ) -> Float64 | None:
        """Goal of the command [D] if the robot is too far from where it is `held`; None where all is well."""
        self.begins = False
        measured = robot.measured(seen, now)
        self._compare(robot, measured, now)
        if measured is None:
            return None
        returned = self._plausibility.returned()
        if not held:
            self._free_at = now
        if not (held or (returned and robot.engaged)) or self._settings.safety.report_only:
            self.goal = None
            return None
        if self.goal is not None:  # joints that are pushed on, past it or back, are left where they are
            on = (self.goal - robot.commanded) * (measured - robot.commanded) > 0.0
            assert self._led is not None
            along = self._angles & self._led.look(
                robot.commanded, measured, self.goal, self._plausibility.speed(), now
            )
            self._off |= along
            self._doubt = self._named(along, robot, measured)
            self.goal = np.where((on & ~along) | ~self._angles, self.goal, robot.commanded)
            if self._led.proven:  # it was a hand: what it does next is followed as well
                self._followed &= self._off
            if self.distance(robot, self.goal) <= _THERE:
                self.goal = None
        allowed = self._sagged if returned or self._meeting else self._settings.safety.following_error
        away = self.goal is None and self._away(robot, measured, allowed)
        self._meeting = self._meeting and (away or self.goal is not None)
        if away:
            where = self._plausibility.middle(measured)
            self.follow(robot, where)
            if self._away(robot, where, allowed):
                limits = self._settings.limits
                goal = np.clip(self.trusted(robot, where), limits.lower, limits.upper)
                # What hangs by its error alone stays: it would sink by it each time that another joint is led.
                self.goal = np.where(np.abs(where - robot.commanded) > self._sagged, goal, robot.commanded)
                self._led = Led(
                    robot.commanded,
                    measured,
                    self._plausibility.speed(),
                    now,
                    at_once=not self._meeting and (bool(returned) or now - self._free_at < _LATELY_S),
                )
                self.begins = True
        return None if self.goal is None or self._led is None else self._led.end(self.goal)

    @property
    def _sagged(self) -> float:
        """How far an arm may be off by its servo error alone [rad]."""
        steady = self._settings.safety.steady_error
        return _RETURNED_AWAY if steady <= _RETURNED_AWAY else steady + _NOISE

    def distance(self, robot: RobotActuator, measured: Float64) -> float:
        """Distance of the farthest joint from its command [rad]."""
        return float(np.abs(measured - robot.commanded).max(where=self._angles, initial=0.0))

    def trusted(self, robot: RobotActuator, measured: Float64) -> Float64:
        """`measured` [D], and where it is told to be for a joint whose readings are not followed."""
        return np.where(self._distrusted, robot.commanded, measured)

    def follow(self, robot: RobotActuator, measured: Float64) -> None:
        """The command is about to be led to `measured` [D]: `doubt` names the joints for which it was before."""
        where = self.trusted(robot, measured)
        away = self._angles & (np.abs(where - robot.commanded) > self._sagged)
        off = away & self._followed
        self._off |= off
        self._followed |= away
        self._doubt = self._named(off, robot, measured)

    def _named(self, off: np.ndarray, robot: RobotActuator, measured: Float64) -> str:
        return "; ".join(
            f"{self._settings.limits.names[i]} reads {measured[i]:.3f} rad, {robot.commanded[i]:.3f} is held, "
            "to which it was led already: is its encoder off?"
            for i in np.flatnonzero(off)
        )

    def reason(self, robot: RobotActuator, measured: Float64 | None) -> str:
        """Why no motion may begin from what is held, "" where one may; `measured` [D], None where not known."""
        if measured is None or not robot.engaged or not self._settings.guarded:
            return ""
        led = self._distrusted | (self._meeting or self.goal is not None)
        away = np.abs(measured - robot.commanded)
        far = self._angles & (away > np.where(led, self._sagged, self._settings.safety.following_error))
        if not far.any():
            return ""
        worst = int(np.where(far, away, 0.0).argmax())
        return _HELD_ELSEWHERE(
            joint=self._settings.limits.names[worst], measured=measured[worst], held=robot.commanded[worst]
        )

    @property
    def speed(self) -> Float64:
        """Velocity at which the command is led [D]: as motions of ours, and as a hand moves what is proven."""
        whole = not self._meeting and self._led is not None and self._led.whole
        scale = 1.0 if whole else self._settings.safety.motion_velocity_scale
        return self._settings.limits.velocity * scale

    def meet(self) -> None:
        """Lead what is held to where joints are read, also those that leapt: the operator wants it there."""
        self.forget()
        self._meeting = True

    def leave_off(self) -> None:
        """Lead on no further for a set-up that is over: where the encoder is off, that would move the robot."""
        if self._meeting:
            self._meeting, self.goal = False, None

    def forget(self) -> None:
        """Follow all joints again."""
        for joints in (self._followed, self._off, self._plausibility.leapt):
            joints[:] = False

    @property
    def _distrusted(self) -> np.ndarray:
        return np.asarray(self._off | self._plausibility.leapt)

    def _away(self, robot: RobotActuator, measured: Float64, allowed: float) -> bool:
        far = self.distance(robot, self.trusted(robot, measured)) > allowed
        return far and self._plausibility.apart(robot.commanded, allowed, self._distrusted)

    def _compare(self, robot: RobotActuator, measured: Float64 | None, now: float) -> None:
        """Follow those joints again that agree with their command."""
        if not robot.engaged:
            self.forget()
            self.goal = None
        apart = True if measured is None else np.abs(measured - robot.commanded) > self._sagged
        self._apart_at[apart & self._angles] = now
        agrees = now - self._apart_at >= _AGREES_S
        for joints in (self._followed, self._plausibility.leapt):
            joints[agrees & ~self._off] = False
