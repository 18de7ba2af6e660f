"""What the commands of the session make happen: set-up, runs, and what a person does within one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from runtime import deployment
from runtime.by_hand import ByHand
from runtime.clock import Clock
from runtime.effects import Effects, Situation, Told
from runtime.errors import RuntimeFault
from runtime.family import Plan
from runtime.inference import Inference
from runtime.messages import Event
from runtime.orders import Orders
from runtime.page import Page
from runtime.requests import GripperRequest, MoveRequest, RunRequest, SetUpRequest, TuneRequest
from runtime.runs import Runs
from runtime.setup import SetUp
from runtime.transitions import State
from runtime.tuning import strategy_of, tuned


@dataclass(frozen=True, slots=True)
class Parts:
    """What operations are carried out with."""

    page: Page
    clock: Clock
    orders: Orders
    inference: Inference
    setup: SetUp
    runs: Runs
    by_hand: ByHand


class Operations(Effects):
    """Carries out what the session has allowed; `plan` is the one in force, `absent` names a process that is silent."""

    def __init__(
        self,
        plan: Plan,
        parts: Parts,
        state: Callable[[], State],
        absent: Callable[[], str],
        say: Callable[[Event], None],
    ) -> None:
        self._own = plan  # the deployment's
        self.plan = plan  # as it was last set up or tuned
        self.page, self.clock = parts.page, parts.clock
        self.inference, self.setup = parts.inference, parts.setup
        self.runs, self.by_hand = parts.runs, parts.by_hand
        self._orders = parts.orders
        self._state, self._absent, self._say = state, absent, say
        self._tuned = False  # since the last set-up

    # --- set-up and runs -------------------------------------------------------------------------------------

    def begin_setup(self, asked: SetUpRequest) -> Told:
        plan, reset = self._changed(asked), self.setup.bench.of(asked.bench)
        policy = self.inference.policy
        if plan.deployment.policy != self.plan.deployment.policy:
            policy = plan.new_policy(self.clock)
        self._orders.tune(plan.deployment.strategy.model_dump())
        self.by_hand.unlock()
        # Nothing is refused from here on.
        checkpoint = asked.checkpoint.model_dump() if asked.checkpoint else {}
        self.plan = plan
        told = replace(self.runs.provenance, plan=plan, checkpoint=checkpoint, bench=reset or {})
        self.runs.provenance = told
        self.inference.exchange(policy, plan.deployment.task)
        self.inference.tune(strategy_of(plan), plan.deployment.task)
        self._tuned = False
        self.setup.begin(reset)
        return {"bench": reset["id"]} if reset else {}

    def _changed(self, asked: SetUpRequest) -> Plan:
        """The plan of a set-up; raises RuntimeFault where it is none, or an open recording would not be about it."""
        resolved = deployment.changed(self._own.resolved, asked.changes, "setup")
        if self.runs.alone and resolved.digest != self.plan.resolved.digest:
            raise RuntimeFault(
                "a recording is open, whose manifest says another policy or task: record stop first"
            )
        return replace(self._own, resolved=resolved)

    def cancel_setup(self, reason: str) -> None:
        self.setup.cancel()
        self._orders.give("hold", reason=reason)
        self.by_hand.stand()

    def begin_run(self, asked: RunRequest) -> Told:
        self._require_family()
        if asked.trial is not None:
            self._require_comparable(asked)
        if (asked.mode or self.plan.deployment.run.mode) == "manual":
            self.by_hand.require_robot("run in the mode manual")
        # A control that was restarted during the set-up merges as the deployment says until it is told.
        self._orders.tune(self.plan.deployment.strategy.model_dump())
        return {"episode": self.runs.begin(self.setup.info, asked)}

    def _require_comparable(self, asked: RunRequest) -> None:
        """What a trial measures is what was set up: nothing by hand, nothing tuned, the policy on the robot."""
        mode = asked.mode or self.plan.deployment.run.mode
        if mode != "continuous":
            raise RuntimeFault(f"a trial runs in the mode continuous, and {mode} was asked for")
        if self._tuned:
            raise RuntimeFault("strategy or task were tuned since the set-up: set up again for a trial")
        if not np.isnan(self.by_hand.grippers.locks).all():
            raise RuntimeFault("a gripper is locked: unlock it, or set up again for a trial")

    # --- what a person does within a run ------------------------------------------------------------

    @property
    def situation(self) -> Situation:
        run, control = self.runs.open, self.page.control.read()
        return Situation(
            mode=run.mode if run else None,
            trial=run is not None and run.trial,
            proposed=self.inference.proposal is not None,
            asked=self.inference.asked,
            executing=int(control["remaining"]) > 0,
            first_action=self.setup.first_action is not None and self.plan.capabilities.moves_robot,
            opening=run is not None and run.begun is None,
            approaching=run is not None and run.approaching,
        )

    def tune(self, asked: TuneRequest) -> Told:
        plan = tuned(self.plan, asked, self.setup.info)
        settings = plan.deployment
        strategy = settings.strategy.model_dump()
        self._orders.tune(strategy)
        if settings.task != self.plan.deployment.task:
            self.setup.first_action = None  # it answered another instruction
        self.plan, self._tuned = plan, True
        self.runs.provenance = replace(self.runs.provenance, plan=plan)
        self.inference.tune(strategy_of(plan), settings.task)
        data = {"strategy": strategy, "task": settings.task, "hash": plan.resolved.digest}
        text = f"strategy {settings.strategy.kind}, task {settings.task!r}"
        self._say(Event("tuned_to", text, self.clock.now(), data=data))
        return {"strategy": strategy, "task": settings.task}

    def step(self) -> None:
        self.inference.step()

    def commit(self) -> None:
        self.inference.commit()

    def cancel(self) -> None:
        self.runs.cancel()
        self.by_hand.stand()

    def move(self, asked: MoveRequest) -> Told:
        return self.by_hand.move(asked)

    def grip(self, asked: GripperRequest) -> Told:
        run = self.runs.open
        if run is not None and run.mode == "sim" and asked.action in ("open", "close"):
            raise RuntimeFault(
                f"gripper: {asked.action} would move the robot's own, and the run's mode is sim; allowed: lock, unlock"
            )
        free = run is None or run.mode == "manual" or self._state() is State.HOLDING
        return self.by_hand.grip(asked, free)

    def approach(self) -> None:
        made, first = self.inference.proposal, self.setup.first_action
        if self._state() is not State.READY and made is not None:
            self.runs.approach(self.by_hand.checked("approach", made.rows[0]))
        elif first is not None:
            self.setup.first_action = self.by_hand.checked("approach", first)
            self.setup.begin_approach()

    # --- what goes on -------------------------------------------------------------------------------

    def hold(self, reason: str) -> None:
        self.runs.hold(reason)
        self.by_hand.stand()

    def resume_run(self) -> None:
        self._require_family()
        self.runs.resume()

    def end_run(self, status: str, reason: str) -> None:
        self.runs.end(status, reason)
        self.by_hand.stand()

    def go_home(self) -> None:
        self.by_hand.require_robot("home")
        self.setup.begin_homing()

    def release_estop(self) -> None:
        self.page.ask_release()

    def start_recording(self) -> Told:
        self._require_family()
        return {"episode": self.runs.record_alone(self.setup.info)}

    def stop_recording(self) -> None:
        self.runs.stop_alone()

    def _require_family(self) -> None:
        """What is sent to a process that is still starting would be lost."""
        absent = self._absent()
        if absent:
            raise RuntimeFault(f"the process {absent} gives no sign of life yet: try again in a moment")
