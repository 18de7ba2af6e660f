"""One control tick: read orders, merge chunks, check alarms, send commands, record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from runtime.core.errors import CodecError, ConfigurationError
from runtime.core.sentences import Pattern, fixed
from runtime.core.types import Float64
from runtime.ipc.messages import (
    LockGrippers,
    Message,
    NodeRequest,
    Order,
    PolicyAway,
    PostedChunk,
    Tune,
    decode,
)
from runtime.ipc.observation_reader import ObservationReader
from runtime.ipc.shared_state import EStop, SharedState
from runtime.processes.control.actuator import (
    Actuator,
    RobotActuator,
    SimulatedActuator,
    TickResult,
    TickSettings,
)
from runtime.processes.control.behaviours import EStopHold, NodeDriven
from runtime.processes.control.chunk_execution import ExecuteChunks, Strategy, build_strategy, dropped_chunk
from runtime.processes.control.command_pipeline import CommandPipeline
from runtime.processes.control.displacement import DisplacementMonitor, stale_heartbeat
from runtime.processes.control.gripper_locks import GripperLocks
from runtime.processes.control.node_peers import NodeHandover, SubscriberCheck
from runtime.processes.control.plausibility import JointPlausibility, TrustingPlausibility
from runtime.processes.control.steady_error import SteadyError
from runtime.processes.control.telemetry import StatusRecord, Telemetry, TickState
from runtime.safety.filter import SafetyFilter
from runtime.transports.base import Sink

_OTHER_RUN = fixed("control.other_run", "control is not following that run any more")
_MERGED_BY = Pattern("control.merged_by", "chunks are merged by {strategy} from now on")
_LEFT_ALONE = fixed(
    "control.left_alone",
    "the robot's position is unknown since its commands ended: set up again",
)
_NO_MOTION = Pattern("control.no_motion", "a motion to {goal}: expected {expected} values")
_MOTION_SPEED = Pattern("control.motion_speed", "a motion at {speed} of its speed; allowed: above 0 up to 1")
_ESTOP = fixed("control.estop", "e-stop")
_CONTRADICTION = fixed("control.contradiction", "joints contradict each other")
_NO_FRESH_JOINTS = fixed("control.no_fresh_joints", "no fresh joints")
_SIMULATION_UNPLACED = Pattern(
    "control.simulation_unplaced",
    "{why}: the start pose of the simulation is unknown",
)
_ROBOT_UNSEEN = Pattern("control.robot_unseen", "{why}: nothing is sent to a robot unseen")
_RELEASED = fixed("control.released", "e-stop released")
_WHAT_ESTOP = fixed("control.what_estop", "e-stop, towards where the robot is")
_SUPERVISOR_GONE = fixed("control.supervisor_gone", "the supervisor is gone")
_AFTER_MISSING_JOINTS = Pattern(
    "control.after_missing_joints",
    "{what}, after joints were missing: nothing is sent; set up again",
)
_WHAT_HELD = fixed("control.what_held", "held where the robot is")
_MOVED_AWAY = Pattern(
    "control.moved_away",
    "the robot is {distance:.2f} rad from its hold target: holding where it is",
)

__all__ = ["Tick", "TickSettings"]
_NOW_S = 0.05  # [s] age of joints that show the arm's present position
_QUIET_S = 1.0  # [s] without an implausible measurement after which the next is reported


class Tick:
    """Body of the control loop, with two pipelines: the robot's and, in a simulated run, the simulated robot's.

    A missed deadline is never caught up: the caller passes the step that is due now, and limits use the time since the
    last command, capped at 1.5 periods.
    """

    def __init__(
        self,
        shared: SharedState,
        sink: Sink,
        safety: SafetyFilter,
        chosen: Strategy,
        settings: TickSettings,
        clock: Callable[[], float],
    ) -> None:
        self._shared_state = shared
        self._safety = safety
        self._strategy = chosen
        self._settings = settings
        self._clock = clock
        self._eyes = ObservationReader(shared)
        self._report = Telemetry(shared)
        self._locks = GripperLocks(settings.limits, settings.switches)
        judges = JointPlausibility if settings.checks_measurements else TrustingPlausibility
        self._plausibility = judges(settings.limits, settings.dims)
        self._displacement = DisplacementMonitor(settings, self._plausibility)
        self._actuator = RobotActuator(shared, sink, settings, clock)
        self._steady = SteadyError(settings, self._actuator.engaged)
        self._hearing = SubscriberCheck(shared, sink, self._report.emit)
        # A restarted control holds the last command; a new one stays disengaged.
        self._robot = self._make_pipeline(self._actuator)
        left = self._report.status["behaviour"].item() == NodeDriven.name.encode()
        self._yielding = NodeHandover(self._actuator.send_node_request, self._report.emit, left)
        self._simulated: CommandPipeline | None = None
        self._simulated_run = 0
        self._left_run = -1  # the run during which the robot was disengaged
        self._doubted = float("-inf")
        self._orphaned = False

    def __call__(self, step: int, planned: float, woke: float | None = None) -> None:
        """Execute tick `step`, planned for `planned` on our clock; the loop woke at `woke`."""
        self._report.begin_tick(step, planned, woke)
        self._seen = self._plausibility.judge(self._eyes.read_latest(), planned, self._moving_command)
        # The order is essential: measurements first, then orders, then the e-stop and the other alarms, which
        # override orders of the same tick, and only then commands.
        for payload in self._shared_state.rings["orders"].drain():
            self._read(payload, step, planned)
        self._look_at_error(planned)
        self._check_estop(planned)
        self._check_heartbeats(planned)
        self._check_plausibility(planned)
        self._check_displaced(planned)
        sent = self._tick_pipelines(step, planned)
        self._yielding.update(isinstance(self._robot.behaviour, NodeDriven), planned)
        self._hearing.poll(planned)
        self._report.add_tick(self._seen, sent, self._simulated is not None)
        self._report.publish(self._seen, self._standing(step, sent))
        for lane in self._pipelines:
            lane.actuator.end_tick(planned)

    def hold_orphaned(self) -> None:
        """Hold from the next tick on, because the supervisor has ended."""
        self._orphaned = True

    @property
    def is_handing_over(self) -> bool:
        """Whether the control word that begins or ends the node's driving must still be repeated to the node."""
        return self._yielding.is_repeating

    @property
    def status(self) -> StatusRecord:
        """Control's status as the next tick will write it; the loop adds its own statistics."""
        return self._report.status

    # --- pipelines -----------------------------------------------------------------------------------------

    @property
    def _pipelines(self) -> tuple[CommandPipeline, ...]:
        return (self._robot,) if self._simulated is None else (self._robot, self._simulated)

    @property
    def _active_pipeline(self) -> CommandPipeline:
        """The pipeline that executes the chunks: of the robot, or in a simulated run of the simulated robot."""
        return self._robot if self._simulated is None else self._simulated

    def _make_pipeline(self, actuator: Actuator) -> CommandPipeline:
        def believed() -> bool:
            return self._plausibility.is_settled

        def known() -> bool:
            return self._plausibility.has_known_sample

        judged = (self._safety, self._locks, self._settings, self._report)
        return CommandPipeline(actuator, *judged, believed, known)

    def _tick_pipelines(self, step: int, planned: float) -> TickResult:
        """Execute a tick of each pipeline; return the result of the pipeline that executes chunks, for the record."""
        sent = TickResult(planned)
        # Nothing may be sent before the guard has read its latch (UNKNOWN).
        if self._shared_state.estop is not EStop.UNKNOWN:
            sent = self._robot.tick(step, planned, self._seen)
            if self._simulated is not None:
                simulated = self._simulated.tick(step, planned, self._seen)
                sent = simulated._replace(notes=(*sent.notes, *simulated.notes), corrected=sent.corrected)
        return sent

    def _standing(self, step: int, sent: TickResult) -> TickState:
        led, run = self._active_pipeline, self._active_pipeline.run
        waits = run is None or run.is_waiting
        empty = run is not None and sent.target is None
        simulated = None if self._simulated is None else self._simulated.actuator.commanded
        measured = self._measured(self._report.planned)
        return TickState(
            trusted_joints=measured is not None and self._plausibility.is_settled,
            implausible_reason=self._seen.implausible_reason
            or self._displacement.reason(self._actuator, measured),
            robot=self._actuator,
            behaviour=self._robot.behaviour,
            simulating=self._simulated is not None and run is not None,
            simulated=simulated,
            remaining=0 if run is None else run.timeline.remaining(step + 1),
            waiting=empty and waits,
            starved=empty and not waits,
            refused=led.refused,
            locked=self._locks.values,
        )

    # --- orders and chunks ---------------------------------------------------------------------------------

    def _read(self, payload: bytes, step: int, now: float) -> None:
        try:
            message = decode(payload)
        except CodecError as error:  # an unreadable message must not end the process that holds the robot
            self._report.emit("unreadable", str(error))
        else:
            self._dispatch(message, step, now)

    def _dispatch(self, message: Message, step: int, now: float) -> None:
        if isinstance(message, PostedChunk):
            self._merge(message, step)
        elif isinstance(message, NodeRequest):
            self._answer("word_refused", self._actuator.send_node_request(message.word, message.data))
        elif isinstance(message, Tune):
            self._tune(message.strategy, step)
        elif isinstance(message, PolicyAway):
            if self._active_pipeline.run is not None and self._active_pipeline.run.number == message.run:
                self._active_pipeline.run.bear(message.until)
        elif isinstance(message, LockGrippers):
            self._lock(message.values)
        elif isinstance(message, Order):
            self._report.order, self._report.run = message.number, message.run
            if not isinstance(self._robot.behaviour, EStopHold):
                self._follow_order(message, now)

    def _answer(self, kind: str, refusal: str) -> None:
        if refusal:
            self._report.emit(kind, refusal)

    def _merge(self, chunk: PostedChunk, step: int) -> None:
        lane, run = self._active_pipeline, self._active_pipeline.run
        if run is None or chunk.run != run.number:
            self._report.add_merge(dropped_chunk(chunk, step, _OTHER_RUN))
            return
        joined = run.join(chunk, step, lane.actuator.commanded)
        self._report.add_merge(joined.merged)
        if joined.too_far:
            lane.hold_because("too_far", joined.distance_note)
        else:
            self._answer("far_start", joined.distance_note)

    def _tune(self, section: Mapping[str, Any], step: int) -> None:
        try:
            chosen = build_strategy(section, self._settings.dims)
        except ConfigurationError as error:
            self._report.emit("tune_refused", str(error))
            return
        before, self._strategy, run = self._strategy.kind, chosen, self._active_pipeline.run
        if run is not None:
            run.tune(chosen, step)
        if chosen.kind != before:
            self._report.emit("tuned", _MERGED_BY(strategy=chosen.kind))

    def _lock(self, values: Float64) -> None:
        before, refusal = str(self._locks), self._locks.set(values, self._active_pipeline.actuator.commanded)
        if refusal:
            self._report.emit("lock_refused", refusal)
            return
        for lane in self._pipelines:
            lane.on_locks_changed()
        if str(self._locks) != before:
            self._report.emit("locked", str(self._locks))

    def _follow_order(self, order: Order, now: float) -> None:
        self._report.limiting.close()
        self._report.nearing.close()
        self._displacement.stop_converging()
        rehearses = order.kind == "hold" or (order.kind == "follow" and order.mode == "sim")
        if order.run != self._simulated_run or not rehearses:
            self._simulated = None
        if order.kind == "silent":
            self._robot.disengage()
        elif order.kind == "yield":
            self._robot.yield_to_node()
        elif order.kind == "hold":
            for lane in self._pipelines:
                lane.hold()
        elif order.kind == "meet":
            self._robot.hold()
            self._displacement.converge_to_measured()
        elif order.kind == "motion":
            self._begin_motion(order, now)
        elif order.mode == "sim":
            self._begin_simulation(order, now)
        elif order.run == self._left_run and not self._actuator.engaged:
            self._report.emit("unmeasured", _LEFT_ALONE)
        elif self._engage(now):
            self._robot.execute_run(self._run(order))

    def _run(self, order: Order) -> ExecuteChunks:
        return ExecuteChunks(order, self._strategy, self._settings)

    def _begin_motion(self, order: Order, now: float) -> None:
        goal = order.goal
        if goal is None or goal.shape != self._locks.values.shape or np.isinf(goal).any():
            self._robot.hold()
            self._report.emit("refusals", _NO_MOTION(goal=goal, expected=len(self._locks.on)))
        elif not 0.0 < order.speed <= 1.0:
            self._robot.hold()
            self._report.emit("refusals", _MOTION_SPEED(speed=order.speed))
        elif self._engage(now):
            if not order.run:  # a set-up: the operator has checked the robot
                self._displacement.trust_all_joints()
            self._robot.move(goal.astype(np.float64), order.speed)

    def _begin_simulation(self, order: Order, now: float) -> None:
        """Hold the robot, and continue the simulated run, or start it at the robot's measured position."""
        self._robot.hold()
        if self._simulated is None:
            measured = self._measured(now)
            if measured is None:
                reason = self._seen.implausible_reason or _NO_FRESH_JOINTS
                self._report.emit("unmeasured", _SIMULATION_UNPLACED(why=reason))
                return
            start = SimulatedActuator(measured, self._settings, self._clock)
            self._simulated, self._simulated_run = self._make_pipeline(start), order.run
        self._simulated.execute_run(self._run(order))

    # --- alarms --------------------------------------------------------------------------------------------

    def _measured(self, now: float) -> Float64 | None:
        """Return the measured joint positions [D]; None if they are unknown, implausible or old."""
        return self._actuator.measured(self._seen, now)

    def _engage(self, now: float) -> bool:
        """Engage the robot at its measured position; return False, and emit the reason, if that is unknown."""
        if not self._actuator.engaged:
            measured = self._measured(now)
            if measured is None or not self._plausibility.is_settled:
                reason = self._seen.implausible_reason or (
                    _NO_FRESH_JOINTS if measured is None else _CONTRADICTION
                )
                self._report.emit("unmeasured", _ROBOT_UNSEEN(why=reason))
                return False
            self._plausibility.reset_zeros()
            self._actuator.engage(measured)
        self._actuator.snap_grippers()
        return True

    def _look_at_error(self, now: float) -> None:
        stopped = self._robot.behaviour if isinstance(self._robot.behaviour, EStopHold) else None
        if (stopped is not None and stopped.is_settling) or self._displacement.goal is not None:
            self._steady.leave_out()
        else:
            self._steady.update(self._actuator, self._measured(now), now)

    def _check_estop(self, now: float) -> None:
        latched = self._shared_state.estop is EStop.LATCHED
        stopped = self._robot.behaviour if isinstance(self._robot.behaviour, EStopHold) else None
        if latched and stopped is None:
            # Before it was ever engaged, no command is known until the robot has been measured.
            commanded = self._settings.limits.with_zero_speeds(self._actuator.commanded.copy())
            position = commanded if self._actuator.engaged else None
            stopped = EStopHold(position, self._actuator.stopping_distance, self._seen.joints_captured)
            self._actuator.zero_velocity()
            self._displacement.stop_converging()
            # Otherwise a gripper on its way to its lock would continue after the release.
            self._lock(np.full(len(self._locks.on), np.nan))
            self._robot.behaviour, self._simulated = stopped, None
            self._report.emit("estopped", _ESTOP)
        elif not latched and stopped is not None:
            self._robot.release()
            self._report.emit("released", _RELEASED)
            return
        measured = None if stopped is None else self._measured(now)
        if stopped is not None and measured is not None and self._shows_it_now(stopped, now):
            self._stop_at(measured, stopped, now)

    def _shows_it_now(self, stopped: EStopHold, now: float) -> bool:
        """Return True if the measured joints show where the arm is after the e-stop was pressed.

        If the e-stop is pressed while measurements are missing, the newest joints are from before the press. The arm
        has moved since, and must not be driven back to them.
        """
        captured = self._seen.joints_captured
        return (
            stopped.was_measured
            or not self._actuator.engaged
            or captured > stopped.captured
            or now - captured <= _NOW_S
        )

    def _stop_at(self, measured: Float64, stopped: EStopHold, now: float) -> None:
        """Move the command of a robot under the e-stop to its `measured` position [D].

        It moves at once within the stopping distance, and beyond that within velocity limits. Joints with a steady
        servo error keep their command.
        """
        actuator, limits = self._actuator, self._settings.limits
        if not actuator.engaged and (self._plausibility.dead or not self._plausibility.is_settled):
            return
        if not actuator.engaged:
            actuator.engage(measured)
            stopped.hold_at(actuator.commanded.copy())
            stopped.kept = limits.position_mask.copy()
        elif stopped.is_settling:
            measured = self._plausibility.median_joints(measured)
            if stopped.kept is None:
                stopped.kept = self._steady.unchanged_joints(actuator, measured, now)
            measured = np.where(stopped.kept, actuator.commanded, measured + self._steady.last_error)
            if not stopped.was_measured:
                self._displacement.update_target(actuator, measured)
            measured = self._displacement.substitute_untrusted(actuator, measured)
            if not stopped.was_measured:
                actuator.rebase_command(measured, _WHAT_ESTOP, stopped.rest)
            # An object in the gripper holds it open: the command stays, or the object would drop.
            stopped.update_measured(
                limits.with_zero_speeds(np.where(limits.grippers, actuator.commanded, measured))
            )

    def _check_heartbeats(self, now: float) -> None:
        kind, reason = "orphaned", str(_SUPERVISOR_GONE if self._orphaned else "")
        if not reason:
            kind, reason = (
                "family",
                stale_heartbeat(self._shared_state, now, self._settings.heartbeat_timeout),
            )
        if reason:
            self._displacement.stop_converging()
        for lane in self._pipelines if reason else ():
            lane.hold_because(kind, reason)

    @property
    def _moving_command(self) -> Float64 | None:
        """Command of the robot [D] if it is being moved; None if its joints are not expected to change."""
        return self._actuator.commanded if self._robot.behaviour.moving and self._actuator.engaged else None

    def _check_plausibility(self, now: float) -> None:
        """Hold the robot while the measured joints are implausible, and emit the reason."""
        doubt = self._seen.implausible_reason
        if (
            not doubt or not self._plausibility.has_known_sample
        ):  # after an outage there is nothing to contradict
            return
        if self._robot.behaviour.moving:
            self._robot.hold_because("implausible", doubt)
        elif now - self._doubted > _QUIET_S:
            self._report.emit("implausible", doubt)
        self._doubted = now

    def _check_displaced(self, now: float) -> None:
        """Hold at the robot's measured position, if it is too far from the commanded position."""
        behaviour = self._robot.behaviour
        stopped = isinstance(behaviour, EStopHold)
        stationary = (self._robot.is_stationary or stopped) and self._actuator.engaged
        where = self._displacement(self._actuator, self._seen, now, stationary, stopped)
        self._report_untrusted_joints()
        if where is None:
            return
        if self._plausibility.dead:
            self._disengage(_AFTER_MISSING_JOINTS(what=self._plausibility.dead))
            return
        goal = where if self._displacement.goal is None else self._displacement.goal
        away = self._displacement.distance(self._actuator, goal)
        farthest = self._displacement.speed * self._actuator.elapsed(now)
        self._actuator.rebase_command(where, _WHAT_HELD, farthest)
        if isinstance(behaviour, EStopHold):
            behaviour.hold_at(self._actuator.commanded.copy())
            return
        if self._displacement.begins:
            self._report_displaced(_MOVED_AWAY(distance=away))
        self._robot.hold_here()

    def _report_untrusted_joints(self) -> None:
        """Emit an event, once, if joints have become distrusted; hold if the robot is moving."""
        doubt = self._displacement.pop_untrusted_reason()
        if doubt and self._robot.behaviour.moving:
            self._robot.hold_because("implausible", doubt)
        elif doubt:
            self._report.emit("implausible", doubt)

    def _disengage(self, reason: str) -> None:
        """Stop sending commands, and emit `reason`.

        The robot cannot be told to hold here. If its node restarted with all joints at 0, the old target would pull the
        robot
        away; if an encoder died, a target made from that encoder's reading would do so.
        """
        self._left_run = self._report.run
        self._report_displaced(reason)
        if isinstance(self._robot.behaviour, EStopHold):
            self._robot.behaviour.release()
            self._actuator.disengage()
        else:
            self._robot.disengage()

    def _report_displaced(self, text: str) -> None:
        self._report.emit("moved_away" if self._robot.behaviour.moving else "displaced", text)
