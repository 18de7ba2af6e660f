"""Operations of the session's commands: set-up, runs, and actions of the operator within a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from runtime.config import loader
from runtime.core.clock import Clock
from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.command_arguments import (
    DiscardRequest,
    GripperRequest,
    RunRequest,
    SetUpRequest,
    TuneRequest,
)
from runtime.ipc.messages import Event, Mode
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import SharedState
from runtime.processes.coordinator.builders import MakePolicy
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.demonstrations import Demonstrations
from runtime.processes.coordinator.inference.inference import Inference
from runtime.processes.coordinator.manual.manual_control import ManualControl
from runtime.processes.coordinator.runs import Runs
from runtime.processes.coordinator.session.transitions import DISCARDED, GuardFacts, TransitionResult
from runtime.processes.coordinator.session.tuning import apply_tuning, strategy_of
from runtime.processes.coordinator.setup.sequence import SetUp
from runtime.station.spec import StationSpec

_RECORDING_OPEN_OF_OTHER_MANIFEST = fixed(
    "operations.recording_open_of_other_manifest",
    "a recording with another policy or task in its manifest is open: record stop first",
)
_COLLECT_WITHOUT_COLLECTION = fixed(
    "operations.collect_without_collection",
    "setup: collect = true, but the deployment has no [collection]; allowed: false",
)
_NO_COLLECT_WITHOUT_POLICY = fixed(
    "operations.no_collect_without_policy",
    "setup: collect = false, but the deployment has no [policy]; allowed: collect = true",
)
_GIVEN_WITH_COLLECT = Pattern(
    "operations.given_with_collect",
    "setup: {given} with collect = true: a person drives; leave it out",
)
_WHAT_RUN_MANUAL = fixed("operations.what_run_manual", "run in the mode manual")
_WHAT_RUN_COLLECT = fixed("operations.what_run_collect", "run in the mode collect")
_MODE_WHILE_COLLECTING = Pattern(
    "operations.mode_while_collecting",
    "run: mode = {mode!r}, but the station is set up to collect; allowed: collect, manual, or set up "
    "with a policy (setup with collect = false)",
)
_UNCOLLECTING = fixed(
    "operations.uncollecting",
    "run: mode = 'collect', but the station has no [collection]: set up with collect = true first",
)
_NOT_SET_UP_TO_COLLECT = fixed(
    "operations.not_set_up_to_collect",
    "run: mode = 'collect', but the station is set up with a policy: set up with collect = true first",
)
_GIVEN_WITHOUT_COLLECT = Pattern(
    "operations.given_without_collect",
    "run: {given} with mode = {mode!r}; allowed with collect alone",
)
_TRIAL_MODE = Pattern(
    "operations.trial_mode",
    "a trial runs in the mode continuous, and {mode} was asked for",
)
_TRIAL_WITHOUT_RECORDING = fixed(
    "operations.trial_without_recording",
    "a trial counts by its recording, and recording.enabled = false; allowed: true",
)
_TRIAL_AFTER_TUNING = fixed(
    "operations.trial_after_tuning",
    "strategy or task were tuned since the set-up: set up again for a trial",
)
_TRIAL_WITH_LOCKED_GRIPPER = fixed(
    "operations.trial_with_locked_gripper",
    "a gripper is locked: unlock it, or set up again for a trial",
)
_TUNE_STRATEGY_WHILE_COLLECTING = fixed(
    "operations.tune_strategy_while_collecting",
    "tune: strategy while the station is set up to collect; allowed: task",
)
_TUNED_TO = Pattern("operations.tuned_to", "strategy {strategy}, task {task!r}")
_GRIPPER_IN_SIM = Pattern(
    "operations.gripper_in_sim",
    "gripper: {action} would move the robot's own, and the run's mode is sim; allowed: lock, unlock",
)

_FAMILY_STARTING = Pattern(
    "operations.family_starting",
    "the process {process} does not answer yet: try again in a moment",
)


@dataclass(frozen=True, slots=True)
class SessionComponents:
    """Components that operations use."""

    shared: SharedState
    clock: Clock
    orders: ControlQueue
    inference: Inference
    setup: SetUp
    runs: Runs
    manual: ManualControl
    collecting: Demonstrations


class SessionActions:
    """Operations that the session has allowed and that involve several components.

    `spec` is the specification of the last set-up or tuning. `absent` returns the name of a process with an expired
    heartbeat. A method that refuses raises RuntimeFault and has changed nothing. Return values become part of the
    answer.
    """

    def __init__(
        self,
        spec: StationSpec,
        parts: SessionComponents,
        state: Callable[[], SessionState],
        absent: Callable[[], str],
        say: Callable[[Event], None],
        make_policy: MakePolicy,
    ) -> None:
        self._own = spec  # the deployment's
        self.spec = spec  # of the last set-up or tuning
        self.shared: SharedState = parts.shared
        self.clock = parts.clock
        self.inference: Inference = parts.inference
        self.setup: SetUp = parts.setup
        self.runs: Runs = parts.runs
        self.manual: ManualControl = parts.manual
        self.collecting: Demonstrations = parts.collecting
        self._orders = parts.orders
        self._state, self._absent, self._say = state, absent, say
        self._make_policy = make_policy
        self._tuned = False  # since the last set-up
        self.by: str = ""  # the client of the present command
        self.command: str = ""  # the present command's uuid

    def set_requester(self, by: str, command: str) -> None:
        """Record who requests the command that is executed next: the client `by`, and the command's uuid `command`."""
        self.by, self.command = by, command

    # --- set-up and runs -------------------------------------------------------------------------------------

    def begin_setup(self, asked: SetUpRequest) -> TransitionResult:
        spec, reset = self._changed_spec(asked), self.setup.bench.from_request(asked.bench)
        policy = self.inference.policy
        policy_changed = spec.deployment.policy != self.spec.deployment.policy
        if spec.collecting != self.spec.collecting or (policy_changed and not spec.collecting):
            policy = self._make_policy(spec, self.clock)
        self._orders.tune(spec.deployment.strategy.model_dump())
        self.manual.unlock()
        # Nothing is refused from here on.
        checkpoint = asked.checkpoint.model_dump() if asked.checkpoint else {}
        self.spec = spec
        self.runs.update_provenance(spec=spec, checkpoint=checkpoint, bench=reset or {})
        self.inference.set_policy(policy, spec.deployment.task)
        self.inference.tune(strategy_of(spec), spec.deployment.task)
        self._tuned = False
        self.collecting.begin_setup(spec.collecting)
        self.setup.begin(reset, asked.least)
        return {"bench": reset["id"]} if reset else {}

    def _changed_spec(self, request: SetUpRequest) -> StationSpec:
        """Return the deployment's specification with the changes of a set-up request.

        Raises:
            RuntimeFault: the result is invalid, or contradicts the manifest of an open recording.
        """
        collects = self._collects(request)
        changes = request.changes | ({"strategy": {"kind": "naive"}} if collects else {})
        resolved = loader.apply_changes(self._own.resolved, changes, "setup")
        if self.runs.is_recording_standalone and resolved.digest != self.spec.resolved.digest:
            raise RuntimeFault(_RECORDING_OPEN_OF_OTHER_MANIFEST)
        return replace(self._own, resolved=resolved, collecting=collects)

    def _collects(self, request: SetUpRequest) -> bool:
        """Return True if the operator drives the robot after this set-up.

        Raises:
            RuntimeFault: the request contradicts the deployment.
        """
        settings = self._own.deployment
        absent = settings.policy.kind == "none" and request.policy is None
        collects = absent if request.collect is None else request.collect
        if collects and settings.collection is None:
            raise RuntimeFault(_COLLECT_WITHOUT_COLLECTION)
        if not collects and absent:
            raise RuntimeFault(_NO_COLLECT_WITHOUT_POLICY)
        unsuitable = [
            name for name in ("policy", "strategy", "checkpoint") if getattr(request, name) is not None
        ]
        if collects and unsuitable:
            raise RuntimeFault(_GIVEN_WITH_COLLECT(given=", ".join(unsuitable)))
        return collects

    def cancel_setup(self, reason: str) -> None:
        self.setup.cancel()
        self._orders.send_order("hold", reason=reason)
        self.manual.stop_grippers()

    def begin_run(self, asked: RunRequest) -> TransitionResult:
        self._require_family()
        if asked.trial is not None:
            self._require_comparable(asked)
        mode = self._mode(asked)
        asked = asked.model_copy(update={"mode": mode})
        if mode == "manual":
            self.manual.require_robot(_WHAT_RUN_MANUAL)
            self.manual.prepare()
        # A control restarted during the set-up merges by the deployment's strategy until it gets this one.
        self._orders.tune(self.spec.deployment.strategy.model_dump())
        collecting = self.collecting
        if mode != "collect":
            return {"episode": self.runs.begin(self.setup.info, asked, command=self.command)}
        self.manual.require_robot(_WHAT_RUN_COLLECT)
        episode = self.runs.begin(self.setup.info, asked, collecting.manifest(asked), self.command)
        collecting.on_episode_started(episode, asked)
        return {"episode": episode}

    def _mode(self, request: RunRequest) -> Mode:
        """Return the mode in which the requested run is to be executed.

        Raises:
            RuntimeFault: the station is not set up for the requested mode, or the request has arguments that need
                another mode.
        """
        collects, settings = self.spec.collecting, self.spec.deployment
        mode = request.mode or ("collect" if collects else settings.run.mode)
        if collects and mode not in ("collect", "manual"):
            raise RuntimeFault(_MODE_WHILE_COLLECTING(mode=mode))
        if mode == "collect" and not collects:
            raise RuntimeFault(_UNCOLLECTING if settings.collection is None else _NOT_SET_UP_TO_COLLECT)
        unsuitable = [name for name in ("task", "session") if getattr(request, name) is not None]
        if unsuitable and mode != "collect":
            raise RuntimeFault(_GIVEN_WITHOUT_COLLECT(given=", ".join(unsuitable), mode=mode))
        return mode

    def _require_comparable(self, request: RunRequest) -> None:
        """Raise RuntimeFault if a trial would not be executed exactly as set up.

        This is the case in a mode other than "continuous", after tuning, with a locked gripper, or without recording.
        """
        mode = self._mode(request)
        if mode != "continuous":
            raise RuntimeFault(_TRIAL_MODE(mode=mode))
        if not self.spec.deployment.recording.enabled:
            raise RuntimeFault(_TRIAL_WITHOUT_RECORDING)
        if self._tuned:
            raise RuntimeFault(_TRIAL_AFTER_TUNING)
        if not np.isnan(self.manual.grippers.locks).all():
            raise RuntimeFault(_TRIAL_WITH_LOCKED_GRIPPER)

    # --- actions within a run -----------------------------------------------------------------------

    @property
    def situation(self) -> GuardFacts:
        run, control = self.runs.open, self.shared.control.read()
        return GuardFacts(
            mode=run.mode if run else None,
            trial=run is not None and run.trial,
            has_proposal=self.inference.proposal is not None,
            is_requesting=self.inference.is_pending,
            executing=int(control["remaining"]) > 0,
            first_action=self.setup.first_action is not None and self.spec.capabilities.moves_robot,
            opening=run is not None and run.begun_at is None,
            approaching=run is not None and run.is_approaching,
            collection=self.collecting.declared,
            collecting=self.spec.collecting,
            armed=self.collecting.armed,
            leader_problem=self.collecting.leader_problem,
            doubt=self.shared.joint_problem if self.spec.capabilities.moves_robot else "",
        )

    def tune(self, asked: TuneRequest) -> TransitionResult:
        """Change strategy, parameters or instruction from now on."""
        if self.spec.collecting and asked.strategy is not None:
            raise RuntimeFault(_TUNE_STRATEGY_WHILE_COLLECTING)
        spec = apply_tuning(self.spec, asked, self.setup.info)
        settings = spec.deployment
        strategy = settings.strategy.model_dump()
        self._orders.tune(strategy)
        if settings.task != self.spec.deployment.task:
            self.setup.set_first_action(None)  # it answered another instruction
        self.spec, self._tuned = spec, True
        self.runs.update_provenance(spec=spec)
        self.inference.tune(strategy_of(spec), settings.task)
        data = {"strategy": strategy, "task": settings.task, "hash": spec.resolved.digest}
        text = _TUNED_TO(strategy=settings.strategy.kind, task=settings.task)
        self._say(Event("tuned_to", text, self.clock.now(), data=data))
        return {"strategy": strategy, "task": settings.task}

    def cancel(self) -> None:
        """Discard the proposal, the rest of the executed chunk, or a motion; then hold, and stop grippers."""
        self.runs.cancel()
        self.manual.stop_grippers()

    def move_gripper(self, asked: GripperRequest) -> TransitionResult:
        run = self.runs.open
        if run is not None and run.mode == "sim" and asked.action in ("open", "close"):
            raise RuntimeFault(_GRIPPER_IN_SIM(action=asked.action))
        free = run is None or run.mode == "manual" or self._state() is SessionState.HOLDING
        return self.manual.move_gripper(asked, free)

    def approach(self) -> None:
        """Move on a limited path to the policy's first action.

        If a proposal is shown during a run, this is the start of the proposal. Otherwise it is the first action that
        the last set-up found.
        """
        proposal, first = self.inference.proposal, self.setup.first_action
        if self._state() is not SessionState.READY and proposal is not None:
            self.runs.approach(self.manual.check_motion("approach", proposal.commands.intended_start))
        elif first is not None:
            self.setup.begin_approach(self.manual.check_motion("approach", first))

    # --- demonstrations -----------------------------------------------------------------------------

    def arm(self) -> None:
        """Permit a demonstration to begin from now on."""
        self._require_family()
        self.collecting.arm()

    def discard(self, asked: DiscardRequest) -> TransitionResult:
        """Mark an episode as discarded.

        If the request names no episode, the open episode is marked, and its run is ended with `end_run`. If no episode
        is open either, the newest one is marked.
        """
        result = self.collecting.discard(asked, self.by)
        if asked.episode is None and self.collecting.run is not None:
            self.end_run("finished", DISCARDED)
        return result

    # --- hold, end, home, record --------------------------------------------------------------------

    def hold(self, reason: str) -> None:
        """Brake, hold, stop querying the policy; a run remains open."""
        self.runs.hold(reason)
        self.manual.stop_grippers()

    def resume_run(self) -> None:
        self._require_family()
        self.runs.resume()

    def end_run(self, status: str, reason: str) -> None:
        """Brake, hold, close the run and its episode, if one is open."""
        self.runs.end(status, reason)
        self.manual.stop_grippers()

    def go_home(self) -> None:
        self.manual.require_robot("home")
        self.setup.begin_homing()

    def start_recording(self) -> TransitionResult:
        self._require_family()
        return {"episode": self.runs.start_standalone_recording(self.setup.info)}

    def _require_family(self) -> None:
        """Raise RuntimeFault if the heartbeat of a process is missing: messages to it would be lost."""
        absent = self._absent()
        if absent:
            raise RuntimeFault(_FAMILY_STARTING(process=absent))
