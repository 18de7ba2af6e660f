"""Inference during a run: when to query, what becomes of a response, and retries."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.core.clock import Clock
from runtime.core.errors import PolicyLostError, RuntimeFault
from runtime.core.sentences import Pattern, fixed
from runtime.core.types import Conditioning, Float64, Observation
from runtime.ipc.messages import Event, MergeResult, Mode, PolicyAnswer, PostedChunk
from runtime.ipc.shared_state import SharedState
from runtime.policies.base import Policy
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.inference.metrics import PolicyMetrics
from runtime.processes.coordinator.inference.policy_observation import StaleObservationError
from runtime.processes.coordinator.inference.requests import PolicyRequests, PolicyResponse
from runtime.processes.coordinator.inference.retry import Retry
from runtime.processes.coordinator.inference.rtc_prefix import RtcPrefix
from runtime.processes.coordinator.inference.runners import as_policy_errors
from runtime.strategies.base import Progress, Query, StrategyParameters

_NOT_ANSWERED_YET = Pattern(
    "policy.not_answered_yet",
    "the policy was asked {seconds:.1f} s ago and has not answered yet",
)
_ANSWER_UNUSABLE = fixed("policy.answer_unusable", "the policy's answer cannot be used")

ON_DEMAND: tuple[Mode, ...] = ("step", "preview")  # modes in which a person requests each chunk


@dataclass(frozen=True, slots=True)
class FaultTimeouts:
    """Times for which a run continues without responses or fresh observations [s]."""

    stale: float  # without a fresh observation, until that is an error
    lost: float  # without a response, until a retried policy is given up


@dataclass(frozen=True, slots=True)
class Strategy:
    """Part of a strategy that decides when to query the policy, with the strategy's parameters."""

    query: Query
    parameters: StrategyParameters


@dataclass(frozen=True, slots=True)
class DisplayedChunk:
    """Newest chunk for pages.

    `state` is "proposed", "merged" or "dropped". `targets` int64 [H] is the control step that each row was planned for,
    -1 if the row was dropped.
    """

    number: int
    run: int
    state: str
    observation_step: int
    targets: NDArray[np.int64]
    rows: Float64
    overlap: int = 0
    ik: Mapping[str, Any] = field(default_factory=dict)  # as in requests.PolicyResponse


class Inference:
    """Controller of a run's inference: queries the policy and sends its chunks; one request in flight."""

    def __init__(
        self,
        requests: PolicyRequests,
        strategy: Strategy,
        shared: SharedState,
        orders: ControlQueue,
        clock: Clock,
        patience: FaultTimeouts,
        commitment: RtcPrefix,
    ) -> None:
        self.requests = requests
        self.runner = requests.runner
        self.metrics = PolicyMetrics()
        self.proposal: PolicyResponse | None = None  # shown, and neither committed nor cancelled
        self.shown: DisplayedChunk | None = None
        self._planned: DisplayedChunk | None = None  # newest chunk that control has merged
        self.rtc_warning = ""
        self._given: Conditioning | None = None  # conditioning of the newest request
        self._strategy = strategy
        self._shared_state = shared
        self._orders = orders
        self._clock = clock
        self._patience = patience
        self._commitment = commitment
        self.retry = Retry(clock, patience.lost, self._note)
        self._run = 0
        self._mode: Mode = "continuous"
        self._wanted = False  # a chunk was requested, in a mode on demand
        self._flight: Future[PolicyResponse] | None = None
        self._unmerged: dict[int, PolicyResponse] = {}  # sent to control
        self._stale_since: float | None = None
        self._asked_at = float("-inf")
        self._generation = 0  # of the RTC prefix at the newest request

    @property
    def policy(self) -> Policy:
        return self.requests.policy

    @property
    def pending_notes(self) -> list[Event]:
        """Events that the coordinator must emit and then remove."""
        return self.requests.notes

    def status(self) -> dict[str, Any]:
        """Return recent metrics, and whether the policy is lost."""
        return {
            "answers": self.metrics.answers,
            **self.metrics.recent(),
            "lost": self.retry.lost_for > 0,
            "retry_in_s": self.retry.due_in,
            "rtc": self.rtc,
        }

    @property
    def simulated(self) -> bool:
        """Whether the policy observes the joints of the simulated robot."""
        return self.requests.policy_observation.simulated

    @property
    def is_pending(self) -> bool:
        """Whether a request is in flight, or its chunk is not merged yet."""
        return self._wanted or self._flight is not None or bool(self._unmerged)

    @property
    def problem(self) -> str:
        """Reason why there may be no chunk: the policy's last failure, or a pending request; "" if there is none."""
        if self.retry.failure or self._flight is None:
            return self.retry.failure
        return _NOT_ANSWERED_YET(seconds=self._clock.now() - self._asked_at)

    @property
    def rtc(self) -> dict[str, Any]:
        """Status of the last conditioning (RTC); {} if the strategy's requests carry no committed rows."""
        if not self.continues:
            return {}
        conditioning = self._given
        return {
            "conditioned": conditioning is not None,
            "predicted_delay": conditioning.predicted_delay if conditioning else None,
            "warning": self.rtc_warning,
        }

    @property
    def continues(self) -> bool:
        """Whether requests carry committed rows (RTC)."""
        return self._strategy.query.uses_rtc

    def set_policy(self, policy: Policy, task: str) -> None:
        """Use `policy` with the instruction `task` from now on, and reset the metrics."""
        self.pause()
        self.requests.set_policy(policy, task)
        self.metrics.reset()
        self.retry.reset()

    def tune(self, strategy: Strategy, task: str) -> None:
        """Change strategy, parameters and instruction; a request in flight remains valid."""
        self._strategy = strategy
        self.requests.set_task(task)
        self.rtc_warning = ""

    def use_simulated(self, simulated: bool) -> None:
        """Select the joints that the policy observes: the simulated or the real robot's."""
        self.requests.policy_observation.use_simulated(simulated)

    # --- a run ---------------------------------------------------------------------------------------------

    def begin(self, run: int, fresh: bool, mode: Mode = "continuous") -> None:
        """Begin to query the policy for this run; `fresh`: the policy must forget the previous episode."""
        self._run, self._mode = run, mode
        if fresh:
            self.requests.reset_episode()
            self.metrics.reset()
            self.shown = self._planned = None
        else:
            self.requests.resume()
        self._commitment.clear()
        self.retry.reset()
        self._stale_since = None
        self._wanted, self.proposal = False, None
        self._unmerged.clear()
        self._asked_at = float("-inf")

    def pause(self) -> None:
        """Stop querying; a response in flight is ignored."""
        self._run = 0
        self._flight = None
        self._wanted, self.proposal, self.shown, self._planned = False, None, None, None
        self._unmerged.clear()
        self._commitment.clear()

    def step(self) -> None:
        """Request one chunk; for the modes "step" and "preview", in which a person requests each chunk."""
        self._wanted = True

    def commit(self) -> None:
        """Send the chunk that a person has reviewed, the `proposal`, to control; do nothing if there is none.

        No row of the chunk is stale, because the robot was at rest during the review.
        """
        if self.proposal is not None:
            proposal, self.proposal = self.proposal, None
            self._post(proposal)

    def cancel(self) -> None:
        """Discard the newest chunk, whether it is requested, shown as a proposal or sent, and clear failures."""
        self._flight, self._stale_since = None, None
        self.retry.reset()
        self._wanted, self.proposal, self.shown, self._planned = False, None, None, None
        self._unmerged.clear()
        self._commitment.clear()

    def forget_plan(self) -> None:
        """Discard commitments and pending responses, because control has dropped its plan."""
        self._flight, self._stale_since = None, None
        self._unmerged.clear()
        self._commitment.clear()
        self.requests.resume()

    # --- merged chunks ---------------------------------------------------------------------------------------

    def on_merged(self, merged: MergeResult) -> None:
        """Record that control has merged or dropped a chunk."""
        response = self._unmerged.pop(merged.chunk_id, None)
        if merged.run != self._run:
            return
        self.metrics.add_merge(merged)
        self._commitment.on_merged(merged)
        if response is not None:
            state = "dropped" if merged.dropped else "merged"
            step = response.observation.step
            self.shown = DisplayedChunk(
                merged.chunk_id,
                merged.run,
                state,
                step,
                merged.targets,
                response.commands.rows,
                merged.overlap,
                response.ik,
            )
            if not merged.dropped:
                self._planned = self.shown

    def raw_action(self, step: int) -> Float64 | None:
        """Return the action for `step` [D] in the newest merged chunk; None if it has none."""
        if self._planned is None:
            return None
        places = np.flatnonzero(self._planned.targets == step)
        return self._planned.rows[places[-1]] if len(places) else None

    # --- requests and responses ------------------------------------------------------------------------------

    def poll(self) -> PolicyAnswer | None:
        """Process a response, or send a request; return the response for the record, if any.

        Raises:
            PolicyError: the request failed; other exceptions are converted.
            RuntimeFault: chunks cannot be sent to control.
        """
        with as_policy_errors(_ANSWER_UNUSABLE):
            return self._pump() if self._run else None

    def _pump(self) -> PolicyAnswer | None:
        self.requests.push_observation()
        if self._flight is not None:
            if not self.runner.ready(self._flight):
                return None
            flight, self._flight = self._flight, None
            return self._on_response(flight.result())
        # A late response of an earlier run may occupy the policy: a request would grow old in the queue.
        if not self.runner.busy and self._should_request() and self._try_request():
            return self._pump()
        return None

    def should_retry(self, error: RuntimeFault) -> bool:
        """Record a failure; return True if the policy will be retried, False if the time for retries is over."""
        if isinstance(error, PolicyLostError):
            self.metrics.count_lost()
        if not self.retry.record_failure(error):
            return False
        self._orders.bear(self._run, self._clock.now() + self._patience.lost - self.retry.lost_for)
        return True

    def _should_request(self) -> bool:
        if self.retry.due_in:
            return False
        return (
            self._wanted if self._mode in ON_DEMAND else self._strategy.query.should_request(self._progress())
        )

    def _progress(self) -> Progress:
        remaining = int(self._shared_state.control.read()["remaining"])
        return Progress(remaining, bool(self._unmerged), self._clock.now() - self._asked_at)

    def _try_request(self) -> bool:
        """Send a request; return True if its response is available at once.

        If the newest observation is too old, no request is sent and False is returned. An error is raised once this has
        lasted longer than permitted. Control also checks the age of observations, but only when it executes an action,
        and it executes none while a strategy waits for this response.
        """
        now = self._clock.now()
        waited = self._mode in ON_DEMAND or self._strategy.query.requests_while_stopped
        try:
            committed = self._committed if self.continues else None
            flight = self.requests.send(waited, committed, self._strategy.parameters.k_max, executed=True)
        except StaleObservationError:
            if self._stale_since is None:
                self._stale_since = now
            if now - self._stale_since > self._patience.stale:
                raise
            return False
        self._stale_since, self._asked_at, self._flight = None, now, flight
        self._generation = self._commitment.generation
        return self.runner.ready(flight)

    def _committed(self, observation: Observation) -> Conditioning | None:
        parameters = self._strategy.parameters
        conditioning = self._commitment.conditioning(
            observation.step,
            list(self.metrics.delays)[-50:],
            parameters.delay_quantile,
            parameters.execution_horizon,
            observation,
        )
        warning = self._commitment.warning
        if warning and not self.rtc_warning:  # its numbers change with every request
            self._note("rtc_warning", warning)
        self.rtc_warning, self._given = warning, conditioning
        return conditioning

    def _on_response(self, response: PolicyResponse) -> PolicyAnswer:
        response = replace(response, number=self._orders.next_chunk())
        step, rows, ik = response.observation.step, response.commands.rows, response.ik
        self.requests.log_ik_problems(response)
        self._wanted = False
        self.metrics.add_response(response.seconds, response.age, ik, response.wall_seconds)
        self._commitment.add_chunk(
            response.number, response.chunk, step, response.requested_while_stopped, self._generation, rows
        )
        if self._mode == "preview":
            self.proposal = response
            nowhere = np.full(len(rows), -1, np.int64)
            self.shown = DisplayedChunk(response.number, self._run, "proposed", step, nowhere, rows, ik=ik)
        else:
            self._post(response)
        recorded = self._record(response)
        self.retry.record_success()  # only now: a policy with unusable responses has not recovered
        return recorded

    def _record(self, response: PolicyResponse) -> PolicyAnswer:
        solved = response.commands.ik_result
        return PolicyAnswer(
            response.number,
            self._run,
            response.observation.step,
            response.chunk.actions,
            response.chunk.space,
            response.commands.source_rows,
            response.seconds * 1000.0,
            position_error=None if solved is None else solved.position_error,
            rotation_error=None if solved is None else solved.rotation_error,
            ik_flags=None if solved is None else solved.flags,
            eef=response.eef if self.policy.uses_poses else "",
        )

    def _post(self, response: PolicyResponse) -> None:
        commands, step = response.commands, response.observation.step
        self._orders.send_chunk(
            PostedChunk(
                response.number,
                self._run,
                step,
                commands.rows,
                response.requested_while_stopped,
                commands.first,
            )
        )
        self._unmerged[response.number] = response

    def _note(self, kind: str, text: str) -> None:
        self.pending_notes.append(Event(kind, text, self._clock.now()))
