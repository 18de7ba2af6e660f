"""Requests to the policy: observation, call on the runner, conversion of the response to commands."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from runtime.core.clock import Clock
from runtime.core.errors import PolicyError, PolicyLostError, RuntimeFault, SetupError
from runtime.core.sentences import Pattern
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.ipc.messages import Event
from runtime.kinematics.base import IkFlag, IkResult
from runtime.policies.base import Policy
from runtime.processes.coordinator.inference.policy_observation import ObservationProvider
from runtime.processes.coordinator.inference.runners import Runner
from runtime.spaces.conversion import ActionSpaces, ChunkStart, CommandRows

log = logging.getLogger(__name__)
_EEF_DISAGREES = Pattern(
    "policy.eef_disagrees",
    '{wrong}; allowed: policy.observation_eef = "fk", or a node that measures that link',
)
_POSES_NOT_REACHED = Pattern(
    "policy.poses_not_reached",
    "{over} of {rows} poses are not reached, the worst by {worst_mm:.1f} mm and {worst_deg:.2f} "
    "degrees: nearest taken ({limit} at a joint limit, {velocity} as fast as joints may, {singular} "
    "near singular)",
)
_OUT_OF_REACH = Pattern(
    "policy.out_of_reach",
    "row {row} of the answer is a pose of {arm} that no joints meet: {mm:.0f} mm and {deg:.0f} degrees are left; "
    "allowed: {allowed_mm:g} mm and {allowed_deg:.0f} degrees (safety.missed_pose): out of reach, or not in metres",
)
_TOO_FAR = Pattern(
    "policy.pose_too_far",
    "row {row} of the answer is a pose that is {distance:.2f} rad from where the joints can be by then; allowed: "
    "{allowed:g} (safety.jump)",
)
_ROWS_REFUSED = Pattern("policy.rows_refused", "{wrong}; the {kept} rows before it are executed")
_EARLY_S = 1e-6  # [s] rounding tolerance of summed times
Committed = Callable[[Observation], Conditioning | None]


@dataclass(frozen=True, slots=True)
class MissBound:
    """Greatest permitted errors of poses that inverse kinematics has solved.

    `position` [m] and `rotation` [rad] bound the errors of a pose; `jump` [rad] bounds how far the joints may lag
    behind the pose.
    """

    position: float
    rotation: float
    jump: float

    def misses(self, solved: IkResult) -> NDArray[np.bool_]:
        """Return the poses whose position or rotation error exceeds its bound, as bool [T, arms]."""
        over: NDArray[np.bool_] = (solved.position_error > self.position) | (
            solved.rotation_error > self.rotation
        )
        return over


@dataclass(frozen=True, slots=True)
class PolicyResponse:
    """Result of a completed inference: chunk, duration [s], observation, and joint commands.

    `seconds` is the latency on the station's clock: in lockstep the declared one, while `wall_seconds` is measured on
    the machine's clock everywhere.

    `commands` are the rows of `chunk`, converted to joint commands. If a row was refused, they end before it, and
    `refused` is the reason, else "". If `requested_while_stopped`, the robot was at rest until the response. `eef` is
    the origin of the observation's poses: "measured" by the robot, or "fk" from its joints.
    """

    chunk: ActionChunk
    seconds: float
    observation: Observation
    commands: CommandRows
    requested_while_stopped: bool = False
    age: float | None = None  # of the oldest stream of the observation at the request [s]
    eef: Literal["measured", "fk"] = "fk"
    ik: Mapping[str, Any] = field(default_factory=dict)  # from `ik_figures`; {} for joints
    refused: str = ""
    wall_seconds: float = 0.0
    number: int = 0  # of its chunk, set on arrival

    def status(self, now: float) -> dict[str, Any]:
        """Return chunk number, row count, and age of the joints in the policy's observation [s]."""
        age = now - self.observation.captured.get("joints", now)
        return {"chunk": self.number, "rows": len(self.commands.rows), "age_s": age}


class PolicyRequests:
    """Sender of requests to a policy; calls are queued and executed one after the other, so that no method waits.

    Kinematics are part of the call: for a chunk of poses they take as long as a small model, too long for the
    coordinator.
    """

    def __init__(
        self,
        policy: Policy,
        task: str,
        spaces: ActionSpaces,
        policy_observation: ObservationProvider,
        runner: Runner,
        clock: Clock,
        bound: MissBound | None = None,
    ) -> None:
        """Prepare requests to `policy`.

        Poses with errors larger than `bound` are refused; if it is None, they are only flagged.
        """
        self.policy = policy
        self._bound = bound
        self.task = task
        self.runner = runner
        self.policy_observation = policy_observation
        self._spaces = spaces
        self._clock = clock
        self._fresh = True
        self._held = False  # robot was held since the last request
        self._glance_at = float("-inf")
        self.notes: list[Event] = []  # events that the coordinator must emit

    def set_policy(self, policy: Policy, task: str) -> None:
        """Use `policy` with the instruction `task` from now on.

        A replaced policy is closed first. Calls are executed one after the other: the new policy is called when the
        last call of the old one has ended, without waiting here.
        """
        if policy is not self.policy:
            self.policy.close()
            self.policy, self._fresh, self._held = policy, True, False
        self.task = task

    def set_task(self, task: str) -> None:
        """Use another instruction from now on."""
        self.task = task

    def reset_episode(self) -> None:
        """Reset the policy before its next inference."""
        self._fresh = True

    def resume(self) -> None:
        """Inform the policy before its next inference that the robot was held."""
        self._held = True

    def end_episode(self) -> None:
        """End the rollout on the policy's server, without waiting.

        A failure is only logged. The policy then ends the rollout before its next request; if that fails too, the
        request fails with the reason.
        """
        policy, self._fresh = self.policy, True

        def end() -> None:
            try:
                policy.end_episode()
            except RuntimeFault as error:
                log.warning("the policy's server may still keep the rollout that is over: %s", error)

        self.runner.submit(end)

    def push_observation(self) -> None:
        """Pass the current observation to the policy's `observe`, if the policy needs one and it is due.

        Missing or stale observations are skipped.
        """
        every, now = self.policy.observe_period_s, self._clock.now()
        if every is None or now < self._glance_at - _EARLY_S:
            return
        due = self._glance_at + every
        self._glance_at = due if due > now else now + every
        try:
            self.policy.observe(self.observe())
        except PolicyError:  # a missing or old observation is reported at the next request
            return

    def observe(self) -> Observation:
        """Return the current observation for the policy.

        Raises:
            PolicyError: there is no observation, or it is too old.
        """
        return self.policy_observation.latest(self.task, self.policy.uses_images)

    def send(
        self,
        waited: bool = False,
        committed: Committed | None = None,
        k_max: int | None = None,
        executed: bool = False,
    ) -> Future[PolicyResponse]:
        """Send a request with the newest observation; return its future response.

        Args:
            waited: the robot is at rest until the response is executed.
            committed: returns the conditioning for the observation (RTC).
            k_max: most rows that may be dropped as stale; None: no bound.
            executed: the response will be executed, so it is cut before the first pose with too large an error.

        Raises:
            PolicyError: the observation is missing or too old.
        """
        observation = self.observe()
        policy, fresh, holding = self.policy, self._fresh, self._held
        measured = observation.eef is not None and policy.observation_eef == "measured"
        sample = observation if measured else replace(observation, eef=None)
        conditioning = committed(sample) if committed else None
        self._fresh = self._held = False

        def infer() -> PolicyResponse:
            try:
                if fresh:
                    policy.reset()
                elif holding:
                    policy.resume()
                begun = self._clock.now()
                completed = sample if measured else replace(sample, eef=self._spaces.eef_of(sample.qpos))
                age = self._clock.now() - min(completed.captured.values())
                wall = time.monotonic()
                chunk = policy.infer(completed, conditioning)
                wall = time.monotonic() - wall
            except PolicyLostError:  # the next connection knows nothing of the reset or resume
                self._fresh, self._held = self._fresh or fresh, self._held or holding
                raise
            seconds = self._clock.now() - begun
            onset = self._chunk_start(completed, waited, waited or fresh, k_max)
            commands = self._spaces.to_command(chunk, completed, onset)
            source: Literal["measured", "fk"] = "measured" if measured else "fk"
            ik = {} if commands.ik_result is None else ik_figures(commands.ik_result)
            commands, refused = (
                self._within(commands, onset.first_row, fresh or holding) if executed else (commands, "")
            )
            return PolicyResponse(chunk, seconds, completed, commands, waited, age, source, ik, refused, wall)

        return self.runner.submit(infer)

    def _chunk_start(
        self, observation: Observation, waited: bool, rests: bool, k_max: int | None
    ) -> ChunkStart:
        """Return where the chunk takes over: the present command, and the first row that can still be executed.

        This row is the one after the newest control step, but at most row `k_max` if `k_max` is given. If the robot
        `waited` for the chunk, it is row 0. If the robot `rests`, the chunk starts from the measured joints instead of
        the command.
        """
        qpos = np.asarray(observation.qpos, dtype=np.float64)
        newest = self.policy_observation.commanded()
        if newest is None:
            return ChunkStart(qpos, qpos)
        step, commanded = newest
        # Computed when the response has arrived, so that rows of steps already sent are counted as passed.
        passed = 0 if waited else max(0, step + 1 - observation.step)
        row = passed if k_max is None else min(passed, k_max)
        return ChunkStart(commanded, qpos if rests else commanded, row)

    def _within(self, commands: CommandRows, first: int, begins: bool) -> tuple[CommandRows, str]:
        """Return the rows up to the first refused pose, and the reason; all rows and "" if no pose is refused.

        Poses before row `first` are not checked, because they will not be executed. A pose is refused if it is out of
        reach, or if the joints would lag behind it by more than the permitted jump. A smaller lag is permitted, because
        the safety filter also limits joint rows. If `begins`, which means that the request is the first after a reset
        or a hold, and row `first` itself is refused for its lag, this row is kept. Control then reports the distance to
        it.

        Raises:
            PolicyError: no row remains.
        """
        solved, bound = commands.ik_result, self._bound
        if solved is None or bound is None:
            return commands, ""
        first = min(first, len(commands.rows) - 1)
        missed = first + np.flatnonzero(bound.misses(solved)[first:].any(axis=1))
        results = ((int(row), *self._refused(commands, int(row), bound)) for row in missed)
        row, wrong, in_reach = next((result for result in results if result[1]), (-1, "", False))
        if not wrong:
            return commands, ""
        usable = row + 1 if row == first and begins and in_reach else row
        if usable <= first:
            raise PolicyError(wrong)
        met = IkResult(
            solved.q[:usable],
            solved.position_error[:usable],
            solved.rotation_error[:usable],
            solved.flags[:usable],
        )
        cut = replace(
            commands, rows=commands.rows[:usable], source_rows=commands.source_rows[:usable], ik_result=met
        )
        return cut, _ROWS_REFUSED(wrong=wrong, kept=usable - first)

    def _refused(self, commands: CommandRows, row: int, bound: MissBound) -> tuple[str, bool]:
        """Return the reason why row `row` is refused, and whether the pose of this row is within reach.

        The reason is "" if the row is not refused.
        """
        free, distance = self._spaces.meet(commands, row)
        over = bound.misses(free)[0]
        if over.any():
            arm = int(over.argmax())
            return _OUT_OF_REACH(
                row=commands.source_rows[row],
                arm=self._spaces.arm_names[arm],
                mm=1000.0 * free.position_error[0, arm],
                deg=np.degrees(free.rotation_error[0, arm]),
                allowed_mm=1000.0 * bound.position,
                allowed_deg=np.degrees(bound.rotation),
            ), False
        if distance > bound.jump:
            return _TOO_FAR(row=commands.source_rows[row], distance=distance, allowed=bound.jump), True
        return "", True

    def check_measured_poses(self, answered: PolicyResponse) -> None:
        """Compare measured poses with those computed from the joints: they may be in another frame.

        If they differ and the policy does not use the poses, an event is queued.

        Raises:
            SetupError: they differ, and the policy uses them.
        """
        observation = answered.observation
        if answered.eef != "measured" or observation.eef is None:
            return
        wrong = self._spaces.pose_mismatch(observation.eef, observation.qpos)
        if wrong and self.policy.uses_poses:
            raise SetupError(_EEF_DISAGREES(wrong=wrong))
        if wrong:
            self.notes.append(Event("eef_disagrees", wrong, self._clock.now(), observation.step))

    def log_ik_problems(self, answered: PolicyResponse) -> None:
        """Queue an event if poses of a response were refused or not reached."""
        ik = answered.ik
        if answered.refused:
            self.notes.append(
                Event("poses_refused", answered.refused, self._clock.now(), answered.observation.step)
            )
        elif ik.get("over"):
            text = _POSES_NOT_REACHED(
                over=ik["over"],
                rows=ik["rows"],
                worst_mm=ik["worst_mm"],
                worst_deg=ik["worst_deg"],
                limit=ik["limit"],
                velocity=ik["velocity"],
                singular=ik["singular"],
            )
            step = answered.observation.step
            self.notes.append(Event("ik_unreached", text, self._clock.now(), step, ik))


def ik_figures(solved: IkResult) -> dict[str, Any]:
    """Return the number of rows with each flag on any arm, and the largest errors [mm, degrees]."""

    def flagged(flag: IkFlag) -> int:
        return int(((solved.flags & flag) != 0).any(axis=1).sum())

    return {
        "rows": len(solved.flags),
        "over": flagged(IkFlag.OVER_TOLERANCE),
        "limit": flagged(IkFlag.AT_LIMIT),
        "velocity": flagged(IkFlag.AT_VELOCITY),
        "singular": flagged(IkFlag.NEAR_SINGULAR),
        "worst_mm": 1000.0 * float(solved.position_error.max(initial=0.0)),
        "worst_deg": float(np.degrees(solved.rotation_error.max(initial=0.0))),
    }
