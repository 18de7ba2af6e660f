"""Alarms on which control holds by itself, without an order of the coordinator.

The alarms are missing heartbeats of processes, and a robot that was displaced.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.ipc.observation_reader import LatestObservation
from runtime.ipc.shared_state import SharedState
from runtime.processes.control.actuator import RobotActuator, TickSettings
from runtime.processes.control.led import Led
from runtime.processes.control.plausibility import JointPlausibility

_SIBLING_SILENT = Pattern("control.sibling_silent", "no sign of life from {process} {since}")
_HELD_ELSEWHERE = Pattern(
    "control.held_elsewhere",
    "{joint} reads {measured:.3f} rad and is held at {held:.3f}: check whether the robot is as it is"
    " shown, then set up again",
)

_AGREES_S = 1.0  # [s] of agreement with the command before readings may move it again
_THERE = 1e-6  # [rad]
_LATELY_S = 1.0  # [s] within which a command may have moved away from a blocked joint
_MOVED = 0.01  # [rad] least change of a command that counts as motion
_BESIDE = 0.02  # [rad] added to `sagged` for an arm under the e-stop
_RESTLESS, _STILL_S = 0.1, 0.3  # [rad/s], [s]: readings that are at rest, or drift slowly
_VERDICTS = 3  # inconclusive convergences after which a joint is distrusted


def stale_heartbeat(shared: SharedState, now: float, allowed: Callable[[str], float]) -> str:
    """Return a message about a process with an expired heartbeat, "" if there is none.

    `allowed` maps the name of each process to its timeout [s].
    """
    for process in ("coordinator", "guard"):
        if not shared.alive(process, now, allowed(process)):
            return _SIBLING_SILENT(process=process, since=shared.describe_silence(process, now))
    return ""


class DisplacementMonitor:
    """Monitor of the displacement of a holding robot; it moves the hold target to the measured position.

    A displaced robot was moved by hand, switched off, or its node was restarted, perhaps during an outage of the
    measurements: sending the old target would move it unexpectedly. A single sample is not enough: several must agree
    (`JointPlausibility.is_displaced`).

    An encoder with an offset causes the same readings. In that case moving the command moves the joint too, so that the
    distance between reading and command remains. Therefore the command does not follow a joint whose reading jumped,
    until reading and command have agreed for _AGREES_S. If a joint is still displaced after its command has been moved
    to the reading, the command does not follow it again before the next set-up, because the operator must check the
    robot.

    A held arm may be displaced by the permitted following error. Under the e-stop, the command of an arm at rest
    already follows a displacement of 0.1 rad: an arm whose drive is off has sagged, and would jump back when the drive
    is switched on.
    """

    def __init__(self, settings: TickSettings, plausibility: JointPlausibility) -> None:
        self._settings = settings
        self._plausibility = plausibility
        self._angles = settings.limits.position_mask
        dim = len(settings.limits.names)
        self._followed = np.zeros(dim, bool)  # joints to whose readings the command was moved
        self._unsaid = np.zeros(dim, np.int64)  # number of such moves without a conclusion
        # Parts in which readings moved with the command, since a hand was last proven.
        self._along = np.zeros(dim, np.int64)
        self._off = np.zeros(dim, bool)  # joints that were displaced again after that: distrusted
        self._apart_at = np.full(dim, float("-inf"))  # last time that each joint was displaced
        self._meeting = False  # a set-up converges to the measured joints, and is not finished
        self.goal: Float64 | None = None  # position to which the command is moved
        self._goal_at_first: Float64 = np.zeros(dim)
        self._restless_at = np.full(dim, float("-inf"))  # last motion of each joint's readings
        self._led: Led | None = None  # the convergence in progress
        self._blind = np.zeros(dim, bool)  # joints that converge without checking their encoder
        self._moved_at = np.full(dim, float("-inf"))  # last motion of each command other than by convergence
        self._moved_from: Float64 = np.full(dim, np.nan)
        self._proven_at = np.full(dim, float("-inf"))  # last proof that a hand moves each joint
        self.begins = False  # a convergence began in this tick
        self._doubt = ""  # message about joints distrusted since the last report

    def pop_untrusted_reason(self) -> str:
        """Return a message about joints distrusted since the last call; "" if there are none."""
        doubt, self._doubt = self._doubt, ""
        return doubt

    def __call__(
        self, robot: RobotActuator, seen: LatestObservation, now: float, held: bool, stopped: bool = False
    ) -> Float64 | None:
        """Return the new command [D] if the robot is too far from its held position, None if it is not.

        Call once per tick. `held` is True if the robot holds a position, `stopped` if it holds because of the e-stop.
        """
        self.begins = False
        self._note_moves(robot, now)
        measured = robot.measured(seen, now)
        self._compare(robot, measured, now)
        if measured is None:
            return None
        returned = self._plausibility.pop_outage()
        if not (held or (returned and robot.engaged)) or self._settings.safety.report_only:
            self.goal = None
            return None
        if self.goal is not None:  # joints that are pushed beyond the goal, or back, are left where they are
            on = (self.goal - robot.commanded) * (measured - robot.commanded) > 0.0
            assert self._led is not None
            along = self._angles & self._led.update(
                robot.commanded, measured, self.goal, self._plausibility.speed(), now
            )
            self._doubt = self._named(along & ~self._off, robot, measured)
            self._off |= along
            self.goal = np.where((on & ~along) | ~self._angles, self.goal, robot.commanded)
            self._proven_at[self._led.alone] = now
            self._along = np.where(self._led.alone, 0, self._led.along)
            if self.distance(robot, self.goal) <= _THERE:
                self._finish(robot)
        safety, still = self._settings.safety, self._still(now)
        allowed = np.full(
            len(measured), safety.sagged if returned or self._meeting else safety.following_error
        )
        if stopped:
            allowed[still] = min(allowed[0], safety.sagged + _BESIDE)
        away = self.goal is None and self._exceeds(robot, measured, allowed)
        self._meeting = self._meeting and (away or self.goal is not None)
        if away:
            where = self._plausibility.median_joints(measured)
            self.update_target(robot, where)
            if self._exceeds(robot, where, allowed):
                limits = self._settings.limits
                goal = np.clip(self.substitute_untrusted(robot, where), limits.lower, limits.upper)
                # A joint displaced by its servo error only stays: otherwise it would sink by that error at each
                # convergence.
                least = np.where(still, safety.sagged, allowed) if stopped else safety.sagged
                self.goal = np.where(np.abs(where - robot.commanded) > least, goal, robot.commanded)
                self._goal_at_first = self.goal
                self._lead(robot, measured, now, bool(returned))
                self.begins = True
        return None if self.goal is None or self._led is None else self._led.end(self.goal)

    def distance(self, robot: RobotActuator, measured: Float64) -> float:
        """Return the displacement of the joint that is farthest from its command [rad]."""
        return float(np.abs(measured - robot.commanded).max(where=self._angles, initial=0.0))

    def substitute_untrusted(self, robot: RobotActuator, measured: Float64) -> Float64:
        """Return `measured` [D], with the commanded position of distrusted joints."""
        return np.where(self._distrusted, robot.commanded, measured)

    def update_target(self, robot: RobotActuator, measured: Float64) -> None:
        """Record that the command is about to move to `measured` [D].

        Joints that are displaced again after the command has already followed them are distrusted from now on.
        """
        where = self.substitute_untrusted(robot, measured)
        away = self._angles & (np.abs(where - robot.commanded) > self._settings.safety.sagged)
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
        """Return a message if a joint is too far from its command for a motion to begin, "" if a motion may begin.

        `measured` [D] is None if unknown; the result is then "".
        """
        if measured is None or not robot.engaged or not self._settings.checks_measurements:
            return ""
        led = self._distrusted | (self._meeting or self.goal is not None)
        away = np.abs(measured - robot.commanded)
        far = self._angles & (
            away > np.where(led, self._settings.safety.sagged, self._settings.safety.following_error)
        )
        if not far.any():
            return ""
        worst = int(np.where(far, away, 0.0).argmax())
        return _HELD_ELSEWHERE(
            joint=self._settings.limits.names[worst], measured=measured[worst], held=robot.commanded[worst]
        )

    @property
    def speed(self) -> Float64:
        """Velocity limits with which the command converges to the measured joints [D].

        Some joints converge in a single motion, without the rests of `Led`. Their limit is the joint's full velocity
        limit. The limit of all other joints is that of generated motions.
        """
        whole = False if self._meeting or self._led is None else self._led.whole
        return self._settings.limits.velocity * np.where(
            whole, 1.0, self._settings.safety.motion_velocity_scale
        )

    def converge_to_measured(self) -> None:
        """Move the hold target to all measured joints, and trust all joints again.

        The operator has asked for this.
        """
        self.trust_all_joints()
        self._meeting = True

    def stop_converging(self) -> None:
        """Stop moving the hold target to the measured joints, because the set-up has ended.

        If an encoder had an offset, following its readings further would move the robot.
        """
        if self._meeting:
            self._meeting, self.goal = False, None

    def trust_all_joints(self) -> None:
        """Trust all joints again."""
        for joints in (self._followed, self._off, self._plausibility.leapt):
            joints[:] = False
        self._unsaid[:], self._along[:] = 0, 0

    def _lead(self, robot: RobotActuator, measured: Float64, now: float, returned: bool) -> None:
        self._blind = returned | (now - self._moved_at < _LATELY_S)
        at_once = self._blind | (now - self._proven_at < _LATELY_S)
        self._proven_at[:] = float("-inf")
        speed = self._plausibility.speed()
        at_once &= not self._meeting
        self._led = Led(robot.commanded, measured, speed, now, at_once=at_once, along=self._along)

    def _finish(self, robot: RobotActuator) -> None:
        """End the convergence, and decide for each joint whether its command may follow its reading again later.

        The command may follow if the joint was proven to move independently of the command. Without proof for a joint,
        the command may follow too, but only until _VERDICTS convergences have ended without proof.
        """
        assert self._led is not None
        verdict = np.where(self._blind, 1, self._led.verdict)
        self._along[verdict < 0] = 0
        came_back = np.abs(self._goal_at_first - robot.commanded) > _THERE
        self._unsaid += self._followed & (verdict == 0) & ~came_back
        self._followed &= (verdict > 0) | ((verdict == 0) & (self._unsaid >= _VERDICTS))
        self.goal = None

    def _note_moves(self, robot: RobotActuator, now: float) -> None:
        moved = np.abs(robot.commanded - self._moved_from) > _MOVED
        if self.goal is None:
            self._moved_at[moved] = now
        self._moved_from = np.where(moved | np.isnan(self._moved_from), robot.commanded, self._moved_from)

    @property
    def _distrusted(self) -> np.ndarray:
        return np.asarray(self._off | self._plausibility.leapt)

    def _exceeds(self, robot: RobotActuator, measured: Float64, allowed: Float64) -> bool:
        apart = np.abs(self.substitute_untrusted(robot, measured) - robot.commanded)
        far = bool((self._angles & (apart > allowed)).any())
        return far and self._plausibility.is_displaced(robot.commanded, allowed, self._distrusted)

    def _still(self, now: float) -> np.ndarray:
        """Return the joints whose readings are at rest, bool [D]."""
        self._restless_at[np.abs(self._plausibility.speed()) > _RESTLESS] = now
        return now - self._restless_at >= _STILL_S

    def _compare(self, robot: RobotActuator, measured: Float64 | None, now: float) -> None:
        """Trust joints again whose readings have agreed with their command for _AGREES_S.

        A joint that was displaced again after its convergence stays distrusted.
        """
        if not robot.engaged:
            self.trust_all_joints()
            self.goal = None
        apart = (
            True if measured is None else np.abs(measured - robot.commanded) > self._settings.safety.sagged
        )
        self._apart_at[apart & self._angles] = now
        agrees = now - self._apart_at >= _AGREES_S
        for joints in (self._followed, self._plausibility.leapt):
            joints[agrees & ~self._off] = False
        self._unsaid[agrees] = 0
