"""Steps of a preflight: connect, reset, two requests, reset, each through the code of a set-up."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RuntimeFault
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.kinematics.base import ChainForward, Kinematics
from runtime.kinematics.lazy import LazyKinematics
from runtime.policies.base import Policy, PolicyInfo
from runtime.preflight.report import Call, Chunk, Report
from runtime.preflight.verdict import PreflightStage, PreflightVerdict, stage_of, verdict_of
from runtime.preflight.virtual_robot import VirtualRobot
from runtime.processes.coordinator.builders import make_kinematics, make_policy
from runtime.processes.coordinator.inference.requests import PolicyRequests, PolicyResponse
from runtime.processes.coordinator.inference.runners import LockstepRunner
from runtime.processes.coordinator.session.tuning import strategy_of
from runtime.processes.coordinator.setup.sequence import check_info, first_action
from runtime.recording import encoder_check
from runtime.spaces.conversion import ActionSpaces
from runtime.station.spec import StationSpec

_TOLERANCE = 1e-6
_LOOK_S = 0.2
Result = TypeVar("Result")


class TimedPolicy(Policy):
    """Policy wrapper that counts and times calls; `current_call` names the call that has not returned."""

    def __init__(self, policy: Policy, clock: Clock) -> None:
        self._policy = policy
        self._clock = clock
        self.observation_eef = policy.observation_eef
        self.uses_poses = policy.uses_poses
        self.calls: list[Call] = []
        self.current_call = ""
        self.since = clock.now()
        self.info: PolicyInfo | None = None

    def connect(self) -> PolicyInfo:
        """Call the policy's `connect`."""
        self.info = self._call("connect", self._policy.connect)
        return self.info

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Call the policy's `infer`."""
        note = (
            "" if any(call.name == "infer" for call in self.calls) else "the first: it may compile the model"
        )
        return self._call("infer", lambda: self._policy.infer(observation, conditioning), note)

    def reset(self) -> None:
        """Call the policy's `reset`."""
        self._call("reset", self._policy.reset)

    def close(self) -> None:
        """Call the policy's `close`."""
        self._policy.close()

    def _call(self, name: str, call: Callable[[], Result], note: str = "") -> Result:
        self.current_call, self.since = name, self._clock.now()
        ok = False
        try:
            result = call()
            ok = True
        finally:
            self.calls.append(Call(name, 1000.0 * (self._clock.now() - self.since), ok, note))
        self.current_call = ""
        return result


class PreflightRunner:
    """Runner of one preflight of one station spec; call `run` once.

    It has no transport, so no action can reach a robot.
    """

    def __init__(self, spec: StationSpec, clock: Clock | None = None) -> None:
        self._plan = spec
        self._clock = clock or MonotonicClock()
        self._begun = self._clock.now()
        self._policy: TimedPolicy | None = None
        self._answered: PolicyResponse | None = None
        self._notes: list[str] = []
        self._loading: float | None = None  # start of the present compilation of kinematics
        self._loaded = 0.0  # total duration of compilation [s]

    def run(self, deadline: float) -> Report:
        """Run all steps within `deadline` [s]; unfinished steps are cut off and reported as a timeout.

        Time in which kinematics are compiled does not count, because it does not depend on the policy.
        """
        ended: list[RuntimeFault | BaseException | None] = []
        thread = threading.Thread(target=lambda: ended.append(self._outcome()), name="preflight", daemon=True)
        thread.start()
        while thread.is_alive() and (left := deadline - self._spent()) > 0:
            thread.join(min(left, _LOOK_S))
        if not ended:
            return self._overdue(deadline)
        error = ended[0]
        if error is None:
            return self._report(PreflightVerdict.OK, PreflightStage.SPACE, self._sentence())
        if not isinstance(error, RuntimeFault):
            raise error
        verdict = verdict_of(error)
        return self._report(verdict, self._stage(verdict), str(error))

    @property
    def _call(self) -> str:
        """Name of the call to the policy that has not returned yet, as `stage_of` expects it.

        If all calls have returned, the name is "connect" until the policy has responded for the first time, and ""
        after that. Without a policy the name is "".
        """
        policy = self._policy
        if policy is None:
            return ""
        return policy.current_call or ("" if self._is_policy_called else "connect")

    @property
    def _is_policy_called(self) -> bool:
        return self._policy is not None and any(call.name == "infer" for call in self._policy.calls)

    def _stage(self, verdict: PreflightVerdict) -> PreflightStage:
        return PreflightStage.RESOLVE if self._policy is None else stage_of(verdict, self._call)

    def _outcome(self) -> BaseException | None:
        try:
            self._run_steps()
        except BaseException as error:  # any exception, for the waiting thread
            return error
        finally:
            if self._policy is not None:
                self._policy.close()
        return None

    def _run_steps(self) -> None:
        spec, runner = self._plan, LockstepRunner(0)
        if spec.deployment.recording.enabled:
            encoder_check.require_encoder(spec.deployment.recording)
        strategy = strategy_of(spec)
        policy = self._policy = TimedPolicy(make_policy(spec, self._clock), self._clock)
        info = runner.submit(policy.connect).result()
        check_info(info, spec, strategy.query.uses_rtc)
        kinematics = LazyKinematics(ChainForward(spec.robot), self._kinematics, runner.run_in_background)
        spaces, subject = ActionSpaces(spec.robot, kinematics, spec.rate), VirtualRobot(spec, self._clock)
        asking = PolicyRequests(policy, spec.deployment.task, spaces, subject, runner, self._clock)
        for _ in range(2):  # the first request resets before
            response = self._answered = asking.send(k_max=strategy.parameters.k_max).result()
        asking.log_ik_problems(response)
        self._notes += [note.text for note in asking.notes]
        runner.submit(
            policy.reset
        ).result()  # the observations were of no robot, so their state must not be continued

    def _kinematics(self) -> Kinematics:
        self._loading = begun = self._clock.now()
        try:
            return make_kinematics(self._plan)
        finally:
            self._loaded, self._loading = self._loaded + self._clock.now() - begun, None

    def _spent(self) -> float:
        now, loading = self._clock.now(), self._loading
        return now - self._begun - self._loaded - (now - loading if loading is not None else 0.0)

    def _overdue(self, deadline: float) -> Report:
        policy = self._policy
        phase = "before the policy was there"
        if policy is not None:
            waited = self._clock.now() - policy.since
            phase = f"while the policy's {policy.current_call} was under way for {waited:.1f} s"
            phase = phase if policy.current_call else "between two calls of the policy"
        report = self._report(
            PreflightVerdict.TIMEOUT,
            self._stage(PreflightVerdict.TIMEOUT),
            f"no end within {deadline:g} s, {phase}",
        )
        if policy is not None:
            policy.close()
        return report

    def _report(self, verdict: PreflightVerdict, stage: PreflightStage, sentence: str) -> Report:
        spec, policy = self._plan, self._policy
        settings = spec.deployment
        info = policy.info if policy else None
        chunk = self._chunk(self._answered) if self._answered else None
        return Report(
            verdict=verdict,
            stage=stage,
            sentence=sentence,
            advice=verdict.advice,
            kind=settings.policy.kind,
            endpoint=str(getattr(settings.policy, "url", "")),
            name=info.name if info else "",
            robot=spec.robot.name,
            control_rate=spec.rate,
            task=settings.task,
            seconds=self._clock.now() - self._begun,
            calls=tuple(policy.calls) if policy else (),
            chunk=chunk,
            metadata=dict(info.metadata) if info else {},
            notes=(*self._notes, *(self._remarks(info, chunk) if chunk else ())),
        )

    def _sentence(self) -> str:
        assert self._answered is not None
        rows, columns = self._answered.chunk.actions.shape
        first = self._chunk(self._answered)
        return (
            f"{rows} rows of {columns} numbers in {self._latency:.0f} ms, the first at most "
            f"{first.first_away:.3f} rad from the pose {self._plan.deployment.setup.pose!r} ({first.first_joint})"
        )

    @property
    def _latency(self) -> float:
        """Duration of the last request [ms]."""
        return [call.ms for call in self._policy.calls if call.name == "infer"][-1] if self._policy else 0.0

    def _chunk(self, response: PolicyResponse) -> Chunk:
        spec, chunk, commands = self._plan, response.chunk, response.commands
        first = first_action(commands.intended_start, np.asarray(response.observation.qpos, np.float64), spec)
        beyond = (spec.limits.excess(commands.rows) > _TOLERANCE).any(axis=1)
        rate = chunk.rate or spec.rate
        return Chunk(
            rows=len(chunk.actions),
            width=chunk.actions.shape[1],
            space=chunk.space,
            mode=chunk.mode,
            rate=rate,
            seconds=len(commands.rows) / spec.rate,
            command_rows=len(commands.rows),
            joints=commands.rows.shape[1],
            first_away=first["distance"],
            first_joint=first["joint"],
            beyond_limits=int(beyond.sum()),
        )

    def _remarks(self, info: PolicyInfo | None, chunk: Chunk) -> list[str]:
        settings, remarks = self._plan.deployment, []
        if chunk.first_away > settings.safety.first_action_far:
            remarks.append(
                f"the first action is far from the pose {settings.setup.pose!r}; it was asked with grey pictures, so "
                "that may mean nothing"
            )
        if chunk.beyond_limits:
            remarks.append(
                f"{chunk.beyond_limits} of {chunk.command_rows} rows leave the joint limits: safety would hold a robot "
                "there"
            )
        if info is not None and info.horizon is not None and info.horizon != chunk.rows:
            remarks.append(f"the server says {info.horizon} rows per answer and gave {chunk.rows}")
        remarks += self._rtc_remarks()
        answers = [call.ms for call in self._policy.calls if call.name == "infer"] if self._policy else []
        if len(answers) > 1 and answers[1] > 1000.0 * chunk.seconds:
            remarks.append(
                f"an answer takes {answers[1]:.0f} ms and is {1000.0 * chunk.seconds:.0f} ms of motion: the "
                "robot will stop and wait"
            )
        return remarks

    def _rtc_remarks(self) -> list[str]:
        """Return remarks if the strategy continues the model's own rows, which must then be absolute."""
        chunk = self._answered.chunk if self._answered else None
        if chunk is None or chunk.model_actions is None or not strategy_of(self._plan).query.uses_rtc:
            return []
        if chunk.mode != "absolute" or chunk.model_relative:
            return [
                "the model's own rows are relative to what it was shown and are not continued: this strategy asks as "
                "async does"
            ]
        if chunk.model_relative is None:
            return [
                "it is not declared whether the model's own rows are absolute; relative ones (openpi's delta joint "
                'actions) would be continued wrongly: set policy.rtc_model_rows = "absolute" or "relative"'
            ]
        return []
