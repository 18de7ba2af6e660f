"""Command pipeline of a robot, real or simulated: from its behaviour to the command that is sent."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from runtime.core.sentences import Pattern, fixed
from runtime.core.types import Float64
from runtime.ipc.observation_reader import LatestObservation
from runtime.motion.timeline import difference
from runtime.motion.trajectories import Trajectory
from runtime.processes.control.actuator import Actuator, TickResult, TickSettings
from runtime.processes.control.behaviours import Behaviour, Disengaged, Hold, MoveTo, NodeDriven, Target
from runtime.processes.control.chunk_execution import ExecuteChunks
from runtime.processes.control.gripper_locks import GripperLocks
from runtime.processes.control.telemetry import Telemetry
from runtime.safety.filter import RobotState, SafetyFilter
from runtime.spaces.binary_grippers import Dwell, snap_grippers

_ACTIONS_AGAIN = Pattern("control.actions_again", "actions again after {seconds:.2f} s")
_IN_A_ROW = Pattern("control.refused_in_a_row", "{count} actions refused in a row, the last one: {why}")
_OF_THE_LAST = Pattern(
    "control.refused_of_the_last",
    "{count} actions refused of the last {of}, the last one: {why}",
)
_JOINTS_MISSING = Pattern(
    "control.joints_missing",
    "{why}: the run is held, and continues by itself if they are back before they are {seconds:g} s old",
)
_JOINTS_BACK = Pattern("control.joints_back", "joints again after {seconds:.2f} s: the run goes on")
_BACK_ELSEWHERE = Pattern(
    "control.back_elsewhere",
    "joints again after {seconds:.2f} s, but {joint} reads {distance:.2f} rad from its command, allowed {allowed:g} "
    "(safety.steady_error): look what moved it, then resume",
)
_NOT_BELIEVED = Pattern("control.not_believed", "joints again after {seconds:.2f} s, but not believed: {why}")
_BACK_LATE = Pattern(
    "control.back_late", "joints were missing for {seconds:.2f} s, allowed {allowed:g} (safety.joint_gap_s)"
)
_DISAGREE = fixed("control.disagree", "samples do not agree yet")
_STARVED = Pattern("control.starved", "no usable chunk for {seconds:.1f} s")
_STARVED_AT_ONCE = fixed("control.starved_at_once", "no usable chunk for this step")
_ARRIVED_THERE = fixed("control.arrived", "arrived")
_NO_ACTION = fixed("control.no_action", "no action for this step: slowing down and holding")

_ARRIVED = 1e-4  # [rad] distance from the end of a motion, the last steps of which may have been limited
_QUIET_S = 1.0  # [s] without a refusal after which the next is reported
_BELIEVED_S = 0.5  # [s] for new joints to become trusted
_GAPS, _GAPS_S = 2, 10.0  # gaps within so many seconds during which a run waits; at the next it holds


@dataclass(slots=True)
class _Gap:
    """Gap in the joint measurements, during which a run waits."""

    since: float  # capture time of the last joints before it, our clock [s]
    unseen: float  # newest tick without fresh joints


class CommandPipeline:
    """Pipeline of commands for one robot, executed once per tick.

    Its parts are, in this order: behaviour, target, gripper locks, safety, actuator.

    A refused action is replaced by the next point of a braking motion, so that a command is sent on every tick. After
    too many refusals, or when actions are missing for too long, the pipeline holds. If actions are refused only because
    the joints are too old, the run brakes and waits for a limited time: it continues by itself if the joints return
    soon and at the commanded position.
    """

    def __init__(
        self,
        actuator: Actuator,
        safety: SafetyFilter,
        locks: GripperLocks,
        settings: TickSettings,
        report: Telemetry,
        believed: Callable[[], bool],
        known: Callable[[], bool],
    ) -> None:
        self._believed = believed  # whether the newest joints are trusted
        self._known = known  # whether any joints were trusted since they were last missing
        self.actuator = actuator
        self._safety = safety
        self._locks = locks
        self._dwell = Dwell(settings.limits)
        self._settings = settings
        self._report = report
        self._standing: Hold | None = None  # braking motion that replaces actions that cannot be sent
        self._aim: Float64 | None = None  # action requested at the last tick, and not refused
        # Refusals among the last actions: if every second action is refused, that is as bad as all of them.
        self._verdicts: deque[bool] = deque(maxlen=2 * settings.safety.refusals_to_hold)
        self._refused_at = float("-inf")
        self.refused = 0  # in a row
        self._unseen = 0  # of the refusals in a row, those of a run for old joints alone
        self._unseen_since = 0.0  # capture time of the last joints before them [s]
        self._gap: _Gap | None = None
        self._gaps: deque[float] = deque(maxlen=_GAPS)  # start times of this run's last gaps
        self.behaviour: Behaviour = Disengaged()
        if actuator.engaged:
            self.hold_here()

    # --- behaviours ----------------------------------------------------------------------------------------

    @property
    def run(self) -> ExecuteChunks | None:
        """Run that is being executed; None if the behaviour is not the execution of chunks."""
        return self.behaviour if isinstance(self.behaviour, ExecuteChunks) else None

    @property
    def is_stationary(self) -> bool:
        """Whether the robot should stay where it is: it holds, or its run has braked to rest."""
        waits = self.run is not None and self._standing is not None and self._standing.at_rest
        return waits or isinstance(self.behaviour, Hold)

    def disengage(self) -> None:
        """Stop sending: the robot is no longer under our control."""
        self._standing = None
        self.actuator.disengage()
        self.behaviour = Disengaged()

    def yield_to_node(self) -> None:
        """Disengage, and let the node drive the robot."""
        self.disengage()
        self.behaviour = NodeDriven()

    def hold(self) -> None:
        """Brake and hold; a node-driven robot is disengaged, and its node then stops it."""
        if isinstance(self.behaviour, NodeDriven):
            self.disengage()
        elif self.actuator.engaged and not isinstance(self.behaviour, Hold):
            self.behaviour = self._standing or self._new_hold()

    def hold_here(self) -> None:
        """Start a new hold from the last command."""
        self._standing = None
        self.behaviour = self._new_hold()

    def release(self) -> None:
        """End the e-stop: hold, or stay disengaged if the robot was not engaged."""
        self.behaviour = self._new_hold() if self.actuator.engaged else Disengaged()

    def hold_because(self, kind: str, reason: str) -> None:
        """Hold on control's own decision, and emit `reason` as an event; do nothing if the robot is not moving."""
        if self.behaviour.moving:
            self.hold()
            self._report.emit(kind, reason)

    def move(self, goal: Float64, speed: float) -> None:
        """Brake, then move to `goal` [D] at `speed`, a share of the speed of generated motions.

        A dimension for which `goal` is NaN stays where braking has stopped it. Dimensions that are speeds end at 0.
        Binary grippers end open or closed, and switch at the beginning of the motion.
        """
        self._begin()
        self._start_motion(snap_grippers(self._settings.switches, goal, self.actuator.commanded), speed)

    def execute_run(self, run: ExecuteChunks) -> None:
        """Execute `run` from the next tick on."""
        self._begin()
        self.behaviour = run

    def on_locks_changed(self) -> None:
        """Restart the present hold or motion with the new locks, because it was planned with the previous ones."""
        self._standing = None
        if isinstance(self.behaviour, Hold):
            self.hold_here()
        elif isinstance(self.behaviour, MoveTo):
            self._start_motion(self.behaviour.goal, self.behaviour.speed)

    def _begin(self) -> None:
        self._standing, self._aim = None, None
        self.refused, self._unseen, self._gap = 0, 0, None
        self._gaps.clear()
        self._verdicts.clear()

    def _start_motion(self, goal: Float64, speed: float) -> None:
        limits, safety = self._settings.limits, self._settings.safety
        brake = self.actuator.braking_motion()
        start = brake.at(brake.duration)
        goal = limits.with_zero_speeds(np.where(np.isnan(goal), start, goal))  # a copy
        if turning := list(self._settings.dims.wrapping):  # endless joints turn the shorter way
            goal[turning] = (start + difference(goal, start, turning))[turning]
        top = limits.velocity * safety.motion_velocity_scale * speed
        begin = np.where(limits.binary, goal, start)
        path = Trajectory(begin, goal, top, safety.motion_acceleration * limits.radian_scale)
        self.behaviour = MoveTo(brake, path, goal, speed)

    def _new_hold(self) -> Hold:
        return Hold(self.actuator.braking_motion())

    # --- one tick ------------------------------------------------------------------------------------------

    def tick(self, step: int, planned: float, seen: LatestObservation) -> TickResult:
        """Send the behaviour's target, as far as locks and safety permit."""
        before = self.actuator.commanded
        sent = self._drive(step, planned, seen)
        if sent.executed is not None:
            self._dwell.record_command(before, sent.executed, planned)
        return sent

    def _drive(self, step: int, planned: float, observation: LatestObservation) -> TickResult:
        run = self.run
        if run is not None and self._gap is not None:
            return self._wait_for_joints(run, self._gap, step, planned, observation)
        if run is not None and self._unseen:
            self._check_joints_returned(run, step, planned, observation)
        target = self.behaviour.target(step, self.actuator.elapsed(planned))
        if target is None:
            return self._nothing_planned(step, planned, observation)
        if target.path is None:
            sent = self._send_hold(step, planned, target, observation)
            self._standing = None  # another stop is sent now: the old one must not continue later
        else:
            sent = self._judge(step, planned, target, observation)
        if isinstance(self.behaviour, MoveTo):
            self._finish(self.behaviour, sent)
        return sent

    def _judge(self, step: int, planned: float, target: Target, observation: LatestObservation) -> TickResult:
        action, notes = self._apply_locks(target.action, planned)
        state = self.actuator.state(observation, planned, self._aim)
        verdict = self._safety.judge(action, state, target.path or "policy")
        if verdict.action is None:
            return self._refuse(step, planned, target, (*notes, *verdict.notes), observation)
        self.refused, self._unseen, self._standing, self._aim = 0, 0, None, action
        self._verdicts.append(False)
        if self.run is not None and (gap := self.run.end_starvation(planned)) is not None:
            self._report.emit("recovered", _ACTIONS_AGAIN(seconds=gap))
        sent = self.actuator.send(step, planned, target, verdict.action, (*notes, *verdict.notes))
        return sent._replace(
            limited=verdict.largest_change_note, change=verdict.change, near=verdict.near_collision
        )

    def _send_hold(
        self, step: int, planned: float, target: Target, observation: LatestObservation
    ) -> TickResult:
        """Send a braking or held target without a safety check.

        A locked gripper that is not at its lock moves there within its limits.
        """
        self._aim = None
        action = target.action
        notes: tuple[str, ...] = ()
        if target.source == "estop":
            action = self._approach(action, observation, planned)
        else:
            locked, notes = self._apply_locks(action, planned)
            if notes:
                action = np.where(self._locks.on, self._to_lock(locked, observation, planned), action)
        return self.actuator.send(step, planned, target, action, notes)

    def _to_lock(self, locked: Float64, observation: LatestObservation, planned: float) -> Float64:
        """Move towards the positions of locked grippers [D] within the limits of generated motions.

        Stop instead if the robot's state is unknown.
        """
        state = self.actuator.state(observation, planned, locked)
        if self._safety.unknown_state_reason(state):
            locked, state = state.previous, replace(state, previous_target=None)
        return self._safety.reachable(locked, state, "motion")

    def _approach(self, where: Float64, observation: LatestObservation, planned: float) -> Float64:
        """Move towards the position that the e-stop holds, within velocity limits; a mobile base stops at once."""
        if not self._settings.checks_measurements:
            return where
        state = self.actuator.state(observation, planned, where)
        reachable = self._safety.reachable(where, state).copy()
        reachable[list(self._settings.limits.speeds)] = where[list(self._settings.limits.speeds)]
        return reachable

    def _apply_locks(self, action: Float64, planned: float) -> tuple[Float64, tuple[str, ...]]:
        """Return `action` [D] with the permitted gripper values, and notes on the changes.

        Locked grippers are held at their locks, binary grippers are snapped to open or closed, and those that switched
        too recently do not switch.
        """
        commanded = self.actuator.commanded
        action, locked = self._locks.apply(action)
        action = snap_grippers(self._settings.switches, action, commanded)
        action, dwelling = self._dwell.apply(action, commanded, planned)
        return action, (*locked, *dwelling)

    def _refuse(
        self,
        step: int,
        planned: float,
        target: Target | None,
        notes: tuple[str, ...],
        observation: LatestObservation,
    ) -> TickResult:
        run, unseen = self.run, self._safety.unseen(self.actuator.state(observation, planned, None))
        if self._unseen and not self._known():  # joints are back, and not yet trusted
            unseen = notes[-1]
        self.refused += 1
        self._unseen_since = self._unseen_since if self._unseen else observation.joints_captured
        self._unseen = self._unseen + 1 if unseen and run is not None else 0
        self._verdicts.append(True)
        self._braking_hold()
        if planned - self._refused_at > _QUIET_S:
            self._report.emit("refused", notes[-1])
        self._refused_at = planned
        refused = sum(self._verdicts)
        if refused < self._settings.safety.refusals_to_hold:
            pass
        elif run is not None and self._unseen >= refused and self._may_wait(planned):
            self._gap = _Gap(self._unseen_since, planned)
            self._gaps.append(planned)
            run.begin_anew()
            seconds = self._settings.safety.joint_gap_s
            self._report.emit("joints_missing", _JOINTS_MISSING(why=unseen, seconds=seconds))
        else:
            fields = {"count": refused, "why": notes[-1]}
            in_row, of = refused == self.refused, len(self._verdicts)
            self.hold_because("refusals", _IN_A_ROW(**fields) if in_row else _OF_THE_LAST(**fields, of=of))
        return self._send_braking(step, planned, observation)._replace(
            target=target, notes=notes, refused=True
        )

    def _wait_for_joints(
        self, run: ExecuteChunks, gap: _Gap, step: int, planned: float, observation: LatestObservation
    ) -> TickResult:
        """Brake and wait until joints are fresh and trusted; then continue with the next chunk, or hold."""
        state, reason = self.actuator.state(observation, planned, None), ""
        allowed, unseen = self._settings.safety.joint_gap_s, self._safety.unseen(state)
        if unseen:
            gap.unseen = planned
        missing = gap.unseen - gap.since  # however old the joints are that arrive meanwhile
        if missing > allowed:
            reason = _IN_A_ROW(count=self.refused, why=unseen or _BACK_LATE(seconds=missing, allowed=allowed))
        elif planned - gap.since > allowed + _BELIEVED_S:  # or control itself was stalled for so long
            reason = _NOT_BELIEVED(seconds=missing, why=state.implausible_reason or _DISAGREE)
        elif not unseen and not state.implausible_reason and self._believed():
            reason = self._elsewhere(state, missing)
            if not reason:
                self._go_on(run, missing)
        if reason:
            self.hold_because("refusals", reason)
        return self._send_braking(step, planned, observation)._replace(refused=True)

    def _check_joints_returned(
        self, run: ExecuteChunks, step: int, planned: float, observation: LatestObservation
    ) -> None:
        """Discard the plan if joints are measured again after a gap, and the plan has moved on without the robot
        meanwhile.
        """
        state = self.actuator.state(observation, planned, None)
        if (
            not self._safety.unseen(state)
            and not state.implausible_reason
            and run.ran_on(step, state.previous)
        ):
            self._go_on(run, planned - self._unseen_since)

    def _may_wait(self, planned: float) -> bool:
        """Return True if the run may wait for joints that are missing.

        This is the case while the present gap in the joints is short, and gaps have not been too frequent. `planned` is
        the planned time of the tick [s].
        """
        often = len(self._gaps) == _GAPS and planned - self._gaps[0] < _GAPS_S
        return not often and planned - self._unseen_since < self._settings.safety.joint_gap_s

    def _elsewhere(self, state: RobotState, missing: float) -> str:
        """Return a message if a joint is away from its commanded position after a gap in the measurements.

        The result is "" if no joint is. `missing` is the duration of the gap [s].
        """
        limits, allowed = self._settings.limits, self._settings.safety.steady_error
        apart = np.where(limits.position_mask, np.abs(state.measured - state.previous), 0.0)
        apart[np.isnan(apart)] = np.inf  # unmeasured joints count as displaced
        worst = int(apart.argmax())
        if apart[worst] <= allowed:
            return ""
        fields = {"joint": limits.names[worst], "distance": apart[worst], "allowed": allowed}
        return _BACK_ELSEWHERE(seconds=missing, **fields)

    def _go_on(self, run: ExecuteChunks, missing: float) -> None:
        run.begin_anew()  # chunks that arrived meanwhile were planned from earlier joints
        self.refused, self._unseen, self._gap = 0, 0, None
        self._verdicts.clear()
        self._report.emit("joints_back", _JOINTS_BACK(seconds=missing))

    def _nothing_planned(self, step: int, planned: float, observation: LatestObservation) -> TickResult:
        run = self.run
        if run is None:
            return TickResult(planned)
        unseen = self._safety.unseen(self.actuator.state(observation, planned, None))
        if unseen and not run.is_waiting:  # without joints a policy cannot answer
            return self._refuse(step, planned, None, (unseen,), observation)
        self._braking_hold()
        starved = run.update_starvation(planned)
        if starved == 0.0:
            self._report.emit("starved", _NO_ACTION)
        borne = self._settings.starvation == "slow" and planned < run.borne_until
        if starved is not None and starved >= self._settings.starvation_patience and not borne:
            self.hold_because("starvation", _STARVED(seconds=starved) if starved else _STARVED_AT_ONCE)
        return self._send_braking(step, planned, observation)

    def _send_braking(self, step: int, planned: float, observation: LatestObservation) -> TickResult:
        """Send the next point of a braking motion instead of a missing or refused action."""
        target = self._braking_hold().target(step, self.actuator.elapsed(planned))
        return self._send_hold(step, planned, target, observation)._replace(target=None)

    def _braking_hold(self) -> Hold:
        """Return the braking motion that replaces missing or refused actions; start one if none is active.

        If the pipeline then holds, this motion continues.
        """
        if self._standing is None:
            self._standing = self._new_hold()
        return self._standing

    def _finish(self, move: MoveTo, sent: TickResult) -> None:
        """Advance the motion by the command that was sent; end it when its goal was sent without refusal or limiting.

        After a refusal, plan the motion again from the present position.
        """
        if sent.executed is None:
            return
        if sent.refused:
            self._start_motion(move.goal, move.speed)  # from its present position, when it may continue
            return
        move.advance()
        left = np.where(self._locks.on, 0.0, np.abs(sent.executed - move.goal))
        if move.finished and left.max() <= _ARRIVED:
            self.hold_here()
            self._report.emit("motion_done", _ARRIVED_THERE)
