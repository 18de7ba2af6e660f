"""Stages of a set-up, all non-blocking: connect, compile once, observe, home, reset, warm up, validate."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from enum import StrEnum
from typing import Any

import numpy as np

from runtime.cameras.base import describe_camera_problems
from runtime.core.clock import Clock
from runtime.core.errors import PolicyError, SetupError
from runtime.core.plugins import variants
from runtime.core.sentences import Pattern, Sentence, fixed, series
from runtime.core.types import Float64
from runtime.ipc.command_arguments import LeastTimes
from runtime.ipc.messages import Event, ReceptionReport
from runtime.ipc.shared_state import SharedState
from runtime.motion import resampling
from runtime.motion.timeline import difference
from runtime.policies.base import PolicyInfo
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.health_monitor import SIBLING_PROCESSES
from runtime.processes.coordinator.inference.inference import Inference
from runtime.processes.coordinator.inference.requests import PolicyResponse
from runtime.processes.coordinator.inference.runners import as_policy_errors
from runtime.processes.coordinator.setup.bench_reset import BenchReset
from runtime.processes.coordinator.setup.motion import SetupMotion
from runtime.station.spec import StationSpec

_THE_POSE = Pattern("setup.the_pose", "the pose {pose!r}")
_THE_FIRST_ACTION = fixed("setup.the_first_action", "the policy's first action")
_POLICY_UNUSABLE = fixed("setup.policy_unusable", "the policy's metadata cannot be used")
_ZERO_JOINTS = Pattern(
    "setup.zero_joints",
    "{joints} read exactly 0 rad: check whether the robot stands so, or an encoder is dead",
)
_NO_FAULT_NAMED = fixed("setup.no_fault_named", "no fault named")
_DRIVES_DISABLED = Pattern(
    "setup.drives_disabled",
    "the robot says that its drives are disabled ({faults}): enable them",
)
_SILENT = Pattern("setup.silent", "the process {process} does not answer")
_NO_DRIVES = Pattern("setup.no_drives", "no ready drives within {seconds:g} s: {why}")
_NO_OBSERVATION = Pattern("setup.no_observation", "no complete observation within {seconds:g} s: {why}")
_VALIDATED = Pattern(
    "setup.validated",
    "{rows} rows in {ms:.0f} ms, the first at most {distance:.3f} rad away ({joint})",
)
_VALIDATED_FAR = Pattern(
    "setup.validated_far",
    "{rows} rows in {ms:.0f} ms, the first at most {distance:.3f} rad away ({joint}): far, approach it or "
    "start elsewhere",
)
_DRIVES_ROBOT = Pattern("setup.drives_robot", "{who} drives the robot")
_ANSWER_UNUSABLE = fixed("setup.answer_unusable", "the policy's answer cannot be used")
_POLICY_WITHOUT_RTC = Pattern(
    "setup.policy_without_rtc",
    "strategy 'rtc': the policy {policy!r} does not continue a chunk that it is given; allowed: another"
    " strategy, or a server and policy.rtc that do",
)
_RESAMPLED = Pattern(
    "setup.resampled",
    "the policy's rows are at {rate:g} Hz (policy.action_rate), and the control rate is {own:g} Hz: with "
    "lockstep.benchmark = true no row is resampled; allowed: the control rate",
)
_HORIZON_TOO_LONG = Pattern(
    "setup.horizon_too_long",
    "strategy.execution_horizon = {wanted} control steps, but the policy {policy!r} says that its "
    "answers have {rows} rows, {steps} control steps; correct the one that is wrong",
)


class Stage(StrEnum):
    """Stage of a set-up."""

    IDLE = "idle"
    CONNECT = "connecting to the policy"
    COMPILE = "compiling the robot's kinematics, once on this machine"
    OBSERVE = "waiting for a complete observation"
    HOME = "going to the pose"
    SETTLE = "waiting for the arm to arrive"
    RESET = "resetting the bench"
    WARM_UP = "warming up the policy"
    APPROACH = "approaching the policy's first action"

    @property
    def sentence(self) -> Sentence:
        """Name of the stage as a text with an id."""
        return _STAGES[self]


_STAGES = {stage: fixed(f"setup.stage.{stage.name.lower()}", stage.value) for stage in Stage}
_ALL = (
    Stage.CONNECT,
    Stage.OBSERVE,
    Stage.HOME,
    Stage.SETTLE,
    Stage.RESET,
    Stage.WARM_UP,
)  # of a whole set-up


class DrivesDisabledError(SetupError):
    """Error that the robot's drives are disabled, although the robot is observed."""


class SetUp:
    """Set-up in progress; call `poll` often, it is cheap."""

    def __init__(
        self,
        spec: StationSpec,
        inference: Inference,
        orders: ControlQueue,
        shared: SharedState,
        clock: Clock,
        reception: Callable[[], ReceptionReport],
        compile_: Callable[[], Future[Any] | None],
    ) -> None:
        self._plan = spec
        self._inference = inference
        self._orders = orders
        self._shared_state = shared
        self._clock = clock
        self._reception = reception  # its latest report
        self._compile = compile_  # starts to compile; returns None if nothing has to be compiled
        self._met = False  # control was ordered to converge to the measured joints
        self._going = SetupMotion(spec, orders, shared, clock)
        self.bench = BenchReset(spec, orders, clock, reception)
        self.stage = Stage.IDLE
        self.info: PolicyInfo | None = None
        self.validated = ""
        self.first_action: Float64 | None = None  # [D] of the newest validated response
        self.stages: dict[Stage, float] = {}  # start times of the stages entered
        self.took: dict[str, float] = {}  # duration of the policy's stages [s], without waiting
        self.failed: Stage | None = None
        self._least = LeastTimes()
        self._compiling: Future[Any] | None = None
        self._motion_only = ""  # result of a motion alone, "" in a whole set-up
        self._reset: dict[str, Any] | None = None  # requested reset of the bench

    @property
    def active(self) -> bool:
        return self.stage is not Stage.IDLE

    @property
    def outcome(self) -> str:
        """Result of the set-up, in one sentence."""
        return self._motion_only or self.validated

    def status(self, now: float) -> dict[str, Any]:
        """Return progress, durations of stages [s], result, and distance of the policy's first action."""
        first = self.first_action
        return {
            "stage": self.stage.sentence,
            "stages": [self._stage_status(stage, now) for stage in self._stages],
            "setup_took": dict(self.took),
            "first_action": {} if first is None else self.distance_of(first),
            "validated": self.validated,
        }

    def distance_of(self, action: Float64) -> dict[str, Any]:
        """Return the distance of an action [D] from the robot's present joints, see `first_action`."""
        return first_action(
            action, np.array(self._shared_state.observation.read()["qpos"], np.float64), self._plan
        )

    @property
    def _stages(self) -> tuple[Stage, ...]:
        """Stages of the newest set-up in order; if it is a motion alone, the stages that were entered."""
        whole = Stage.CONNECT in self.stages or not self.stages
        if not whole or Stage.COMPILE not in self.stages:
            return _ALL if whole else tuple(self.stages)
        return (_ALL[0], Stage.COMPILE, *_ALL[1:])

    def _stage_status(self, stage: Stage, now: float) -> dict[str, Any]:
        """Return state and duration of a stage."""
        since = self.stages.get(stage)
        if stage is self.stage:
            state = "active"
        elif stage is self.failed:
            state = "failed"
        elif since is not None:
            state = "done"
        else:
            state = "waiting" if self.active or not self.stages else "skipped"
        seconds = 0.0
        if since is not None:
            later = [at for name, at in self.stages.items() if name is not stage and at >= since]
            seconds = min(later, default=now) - since
        return {"name": stage.sentence, "state": state, "seconds": seconds}

    def begin(self, reset: dict[str, Any] | None, least: LeastTimes | None = None) -> None:
        """Begin with the first stage.

        `reset` is the result of `BenchReset.from_request`, `least` are least durations of stages.
        """
        self._reset = reset
        self._least = least or LeastTimes()
        self.took = {}
        self.info, self.validated, self.first_action = None, "", None
        self._motion_only, self._met = "", False
        self._start()
        self._connection = self._inference.runner.submit(self._inference.policy.connect)
        self._enter(Stage.CONNECT)

    def begin_homing(self) -> None:
        """Begin a motion to the deployment's pose, without the other stages.

        Raises:
            RuntimeFault: the path is not free; nothing has changed.
        """
        pose = self._plan.deployment.setup.pose
        where = _THE_POSE(pose=pose)
        self._begin_motion_only(self._plan.robot.poses[pose], where, Stage.HOME)

    def begin_approach(self, first_action: Float64) -> None:
        """Begin a motion to the policy's first action [D], without the other stages of a set-up.

        The caller must have checked that this position is allowed.

        Raises:
            RuntimeFault: the path is not free.
        """
        self.set_first_action(first_action)
        self._begin_motion_only(first_action, _THE_FIRST_ACTION, Stage.APPROACH)

    def set_first_action(self, first_action: Float64 | None) -> None:
        """Set the first action [D] of the policy or leader; None if unknown."""
        self.first_action = first_action

    def _begin_motion_only(self, goal: Float64, where: str, stage: Stage) -> None:
        self._going.start(goal, where)
        self._motion_only = f"at {where}"
        self._start()
        self._enter(stage)

    def _start(self) -> None:
        self.stages, self.failed = {}, None

    def fail(self) -> None:
        """Cancel the set-up, and record the stage that failed."""
        self.failed = self.stage
        self.cancel()

    def cancel(self) -> None:
        """Cancel the set-up; a running call to the policy is interrupted."""
        if self.stage in (Stage.CONNECT, Stage.WARM_UP):
            self._inference.policy.close()
        self.stage = Stage.IDLE

    def on_event(self, event: Event) -> None:
        """Process an event of control; it may report that a motion is done, or that a control word was refused."""
        if self.stage in (Stage.HOME, Stage.APPROACH) and self._going.is_sent(event):
            self._enter(Stage.SETTLE)
        self.bench.on_event(event)

    def poll(self) -> bool:
        """Advance the set-up; return True when it is done.

        Raises:
            RuntimeFault: the set-up cannot continue.
        """
        if self.stage is Stage.CONNECT:
            ready = self._inference.runner.ready(self._connection)
            if ready and self._stage_lasted("connect_s", self._least.connect_s):
                with as_policy_errors(_POLICY_UNUSABLE):
                    self.info = self._connection.result()
                    check_info(self.info, self._plan, self._inference.continues)
                self._compiling = self._compile()
                waits = self._compiling is not None and not self._compiling.done()
                self._enter(Stage.COMPILE if waits else Stage.OBSERVE)
        elif self.stage is Stage.COMPILE:
            # A failure is reported to the code that needs kinematics: most policies use joints and need none.
            if self._compiling is None or self._compiling.done():
                self._enter(Stage.OBSERVE)
        elif self.stage is Stage.OBSERVE:
            return self._observe()
        elif self.stage in (Stage.HOME, Stage.APPROACH):
            self._require_family()
            self._going.require_progress()
        elif self.stage is Stage.SETTLE:
            return self._settle()
        elif self.stage is Stage.RESET:
            return self.bench.is_done() and self._start_warm_up()
        elif self.stage is Stage.WARM_UP:
            return self._warm_up()
        return False

    def _enter(self, stage: Stage) -> None:
        self.stage = stage
        self._since = self._clock.now()
        self.stages[stage] = self._since

    def _check_joints(self) -> None:
        doubt = self._shared_state.joint_problem if self._plan.capabilities.moves_robot else ""
        if not doubt:
            return
        if self._shared_state.control.read()["believed"] and not self._met:
            self._met = True
            self._orders.send_order("meet")
        raise SetupError(doubt)

    def _report_zero_joints(self) -> None:
        """Emit an event about joints that read exactly 0.

        A dead encoder reads 0 from the first sample on, so that only the operator can tell it from a joint that is at
        0. Simulated robots have no encoders.
        """
        limits = self._plan.limits
        joints = self._shared_state.observation.read()["qpos"]
        zero = [limits.names[i] for i in np.flatnonzero(limits.position_mask & (joints == 0.0))]
        if zero and self._plan.capabilities.moves_robot and not self._plan.capabilities.bench:
            text = _ZERO_JOINTS(joints=", ".join(zero))
            self._inference.pending_notes.append(Event("zero_joints", text, self._clock.now()))

    def _check_drives(self) -> None:
        drives = self._reception().drives
        if self._plan.capabilities.moves_robot and drives.get("enabled") is False:
            faults = ", ".join(map(str, drives.get("faults", ()))) or _NO_FAULT_NAMED
            raise DrivesDisabledError(_DRIVES_DISABLED(faults=faults))

    def _check_cameras(self) -> None:
        problems = describe_camera_problems(self._reception().cameras)
        if problems:
            raise SetupError(series(problems))

    def _waited(self) -> float:
        return self._clock.now() - self._since

    def _observe(self) -> bool:
        settings = self._plan.deployment.setup
        try:
            self._require_family()
            self._check_cameras()
            self._inference.requests.observe()
            self._check_joints()
            self._check_drives()
        except (PolicyError, SetupError) as error:
            if self._waited() <= settings.observation_timeout_s:
                return False
            missing = _NO_DRIVES if isinstance(error, DrivesDisabledError) else _NO_OBSERVATION
            raise SetupError(missing(seconds=settings.observation_timeout_s, why=str(error))) from None
        self._report_zero_joints()
        if settings.home and self._plan.capabilities.moves_robot:
            self._go_home()
            return False
        return self._start_reset()

    def _require_family(self) -> None:
        """Raise SetupError if a process has an expired heartbeat.

        Orders to a silent control would be lost, and without the guard's heartbeat control only holds.
        """
        within = self._plan.deployment.heartbeat_timeout_s
        for process in SIBLING_PROCESSES:
            if not self._shared_state.alive(process, self._clock.now(), within(process)):
                raise SetupError(_SILENT(process=process))

    def _go_home(self) -> None:
        pose = self._plan.deployment.setup.pose
        self._going.start(self._plan.robot.poses[pose], _THE_POSE(pose=pose))
        self._enter(Stage.HOME)

    def _settle(self) -> bool:
        if not self._going.has_arrived():
            return False
        if self._motion_only:
            self.stage = Stage.IDLE
            return True
        return self._start_reset()

    def _start_reset(self) -> bool:
        """Start the reset of the bench, now that the arms are out of the way.

        If no reset was requested, start the warm-up. Return True if the set-up is then complete.
        """
        if self._reset is None:
            return self._start_warm_up()
        self.bench.start(self._reset)
        self._enter(Stage.RESET)
        return False

    def _start_warm_up(self) -> bool:
        """Begin to query the policy; return True if it is never queried, which ends the set-up."""
        if not self._inference.policy.is_queried:
            self.validated = _DRIVES_ROBOT(who=self.info.name if self.info else "the node")
            self.stage = Stage.IDLE
            return True
        self._left = self._plan.deployment.setup.warmup_chunks
        self._asked: Future[PolicyResponse] | None = None
        self._enter(Stage.WARM_UP)
        return False

    def _warm_up(self) -> bool:
        if self._left and not self._answered():
            return False
        if self._left or not self._stage_lasted("warm_up_s", self._least.warm_up_s):
            return False
        self.stage = Stage.IDLE
        return True

    def _answered(self) -> bool:
        """Send a request, or validate the response to it; return True if a response was validated."""
        if self._asked is None:
            self._asked = self._inference.requests.send()
            return False
        if not self._inference.runner.ready(self._asked):
            return False
        pending, self._asked = self._asked, None
        with as_policy_errors(_ANSWER_UNUSABLE):
            self._validate(pending.result())
        self._left -= 1
        return True

    def _stage_lasted(self, name: str, least: float) -> bool:
        """Return True if the stage has lasted at least `least` [s].

        Least durations keep people from recognising a policy in a blind comparison by the duration of a stage.
        """
        waited = self._waited()
        self.took.setdefault(name, waited)
        return waited >= least

    def _validate(self, response: PolicyResponse) -> None:
        self._inference.requests.log_ik_problems(response)
        if self._left == self._plan.deployment.setup.warmup_chunks:
            self._inference.requests.check_measured_poses(response)
        self.first_action = response.commands.intended_start
        first = first_action(self.first_action, np.asarray(response.observation.qpos, np.float64), self._plan)
        self.validated = (_VALIDATED_FAR if first["far"] else _VALIDATED)(
            rows=len(response.chunk.actions),
            ms=response.seconds * 1000,
            distance=first["distance"],
            joint=first["joint"],
        )


def check_info(info: PolicyInfo, spec: StationSpec, continues: bool) -> None:
    """Compare a policy's description with the strategy.

    `continues`: the strategy's requests carry committed rows.

    Raises:
        SetupError: description and strategy contradict each other; the message names both.
    """
    # A server that ignores the conditioning silently appears to work, but executes another method.
    if continues and info.supports_rtc is False:
        raise SetupError(_POLICY_WITHOUT_RTC(policy=info.name))
    if spec.deployment.lockstep.benchmark and (info.rate or spec.rate) != spec.rate:
        raise SetupError(_RESAMPLED(rate=info.rate, own=spec.rate))
    # The horizon cannot exceed the rows of a response.
    strategy = spec.deployment.strategy
    horizon, uses = strategy.execution_horizon, variants("runtime.strategies")[strategy.kind].USES
    if horizon is None or info.horizon is None or "execution_horizon" not in uses:
        return
    steps = resampling.resampled_length(info.horizon, info.rate or spec.rate, spec.rate)
    if horizon > steps:
        raise SetupError(_HORIZON_TOO_LONG(wanted=horizon, policy=info.name, rows=info.horizon, steps=steps))


def first_action(action: Float64, joints: Float64, spec: StationSpec) -> dict[str, Any]:
    """Return the distance of the action `action` [D] from `joints` [D], as a dict.

    "distance" is the distance [rad] of the joint that is farthest away, "joint" is the name of this joint, and "far" is
    True if the distance exceeds `safety.first_action_far`. Only joint positions count, neither grippers nor speeds.
    """
    limits = spec.limits
    away = np.where(limits.position_mask, np.abs(difference(action, joints, spec.dims.wrapping)), 0.0)
    worst = int(away.argmax())
    far = bool(away[worst] > spec.deployment.safety.first_action_far)
    return {"distance": float(away[worst]), "joint": limits.names[worst], "far": far}
