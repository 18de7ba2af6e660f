"""One question to the policy: what it is shown, where the call is made, what its answer means in commands."""

from __future__ import annotations

import logging
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
from runtime.processes.coordinator.inference.worker import Runner
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
_EARLY_S = 1e-6  # moments are sums of floats
Committed = Callable[[Observation], Conditioning | None]


@dataclass(frozen=True, slots=True)
class MissBound:
    """Farthest that any joints may miss a pose of a policy, [m] and [rad], and that they may lag behind it [rad]."""

    position: float
    rotation: float
    jump: float

    def misses(self, solved: IkResult) -> NDArray[np.bool_]:
        """bool [T, arms]: by more than that."""
        over: NDArray[np.bool_] = (solved.position_error > self.position) | (
            solved.rotation_error > self.rotation
        )
        return over


@dataclass(frozen=True, slots=True)
class PolicyResponse:
    """An inference that came back: the chunk, how long it took [s], what it was asked about, what it means.

    `made` are its rows in command space, up to the first that was `refused`. `waited`: the robot stood meanwhile. `eef`
    says where the poses of the observation come from: the robot's own measurement, or its joints.
    """

    chunk: ActionChunk
    seconds: float
    observation: Observation
    commands: CommandRows
    requested_while_stopped: bool = False
    age: float | None = None  # of the oldest stream of the observation when the policy was asked [s]
    eef: Literal["measured", "fk"] = "fk"
    ik: Mapping[str, Any] = field(
        default_factory=dict
    )  # how its poses were met, as by `figures`; {} for joints
    refused: str = ""


class PolicyRequests:
    """Asks one policy; calls are made one after the other, and nobody waits for them here.

    Kinematics belong to the call: for a chunk of poses they take as long as a small model; the coordinator must not.
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
        """`bound`: poses that are missed by more are refused; None: they are flagged alone."""
        self.policy = policy
        self._bound = bound
        self.task = task
        self.runner = runner
        self.policy_observation = policy_observation
        self._spaces = spaces
        self._clock = clock
        self._fresh = True
        self._held = False  # since it was last asked
        self._glance_at = float("-inf")
        self.notes: list[Event] = []  # for the coordinator to collect

    def set_policy(self, policy: Policy, task: str) -> None:
        """Ask `policy`, with the instruction `task`, from now on.

        Another policy takes the place of the former one, which is closed first. Calls are made one after the
        other: the new one is reached when the last call of the former one is over, and nobody waits for that.
        """
        if policy is not self.policy:
            self.policy.close()
            self.policy, self._fresh, self._held = policy, True, False
        self.task = task

    def set_task(self, task: str) -> None:
        """Ask with another instruction from now on."""
        self.task = task

    def reset_episode(self) -> None:
        """Let the policy forget the episode before its next inference."""
        self._fresh = True

    def resume(self) -> None:
        """Let the policy know before its next inference that the robot was held meanwhile."""
        self._held = True

    def end_episode(self) -> None:
        """The rollout is over: the policy ends what its server keeps of it, and nobody waits for that.

        Where it cannot, the log says so: a policy that owes it does it before it is asked again, or says why not.
        """
        policy, self._fresh = self.policy, True

        def end() -> None:
            try:
                policy.end_episode()
            except RuntimeFault as error:
                log.warning("the policy's server may still keep the rollout that is over: %s", error)

        self.runner.submit(end)

    def push_observation(self) -> None:
        """Show the policy what is seen now, where it wants that and it is time; a gap in what is seen is left one."""
        every, now = self.policy.observe_period_s, self._clock.now()
        if every is None or now < self._glance_at - _EARLY_S:
            return
        due = self._glance_at + every
        self._glance_at = due if due > now else now + every
        try:
            self.policy.observe(self.observe())
        except PolicyError:  # what is missing or old is said of the next request
            return

    def observe(self) -> Observation:
        """The observation to show the policy now; PolicyError where there is none, or it is old."""
        return self.policy_observation.latest(self.task, self.policy.uses_images)

    def send(
        self,
        waited: bool = False,
        committed: Committed | None = None,
        k_max: int | None = None,
        executed: bool = False,
    ) -> Future[PolicyResponse]:
        """Send one request about the newest observation; raises PolicyError where that is too old.

        `k_max` is how many rows of the answer may be dropped as stale at most, None: as many as are. The answer of one
        that is to be `executed` ends before the first pose that is missed by far.
        """
        observation = self.observe()
        policy, fresh, held = self.policy, self._fresh, self._held
        measured = observation.eef is not None and policy.observation_eef == "measured"
        seen = observation if measured else replace(observation, eef=None)
        conditioning = committed(seen) if committed else None
        self._fresh = self._held = False

        def infer() -> PolicyResponse:
            try:
                if fresh:
                    policy.reset()
                elif held:
                    policy.resume()
                begun = self._clock.now()
                shown = seen if measured else replace(seen, eef=self._spaces.eef_of(seen.qpos))
                age = self._clock.now() - min(shown.captured.values())
                chunk = policy.infer(shown, conditioning)
            except PolicyLostError:  # the one that is there again has heard nothing of it
                self._fresh, self._held = self._fresh or fresh, self._held or held
                raise
            seconds = self._clock.now() - begun
            onset = self._chunk_start(shown, waited, waited or fresh, k_max)
            made = self._spaces.to_command(chunk, shown, onset)
            source: Literal["measured", "fk"] = "measured" if measured else "fk"
            ik = {} if made.ik_result is None else ik_figures(made.ik_result)
            made, refused = self._within(made, onset.first_row, fresh or held) if executed else (made, "")
            return PolicyResponse(chunk, seconds, shown, made, waited, age, source, ik, refused)

        return self.runner.submit(infer)

    def _chunk_start(self, shown: Observation, waited: bool, rests: bool, k_max: int | None) -> ChunkStart:
        """Onset of the answer, as far as it is known now: at what control was told to do last.

        Its first row that can still be executed follows the newest control step. A robot that rests starts from
        where it is measured.
        """
        qpos = np.asarray(shown.qpos, dtype=np.float64)
        told = self.policy_observation.commanded()
        if told is None:
            return ChunkStart(qpos, qpos)
        step, commanded = told
        passed = 0 if waited else max(0, step + 1 - shown.step)
        row = passed if k_max is None else min(passed, k_max)
        return ChunkStart(commanded, qpos if rests else commanded, row)

    def _within(self, made: CommandRows, first: int, begins: bool) -> tuple[CommandRows, str]:
        """The rows before the first pose from row `first` on that is refused, and why no more; PolicyError for none.

        Refused is what no joints meet, and what is farther from where joints can be by then than a jump: joints that
        lag behind a pose by less are those of joint rows that the limits of safety hold back. Where a run `begins` so,
        control says it, by that one row.
        """
        solved, bound = made.ik_result, self._bound
        if solved is None or bound is None:
            return made, ""
        first = min(first, len(made.rows) - 1)
        missed = first + np.flatnonzero(bound.misses(solved)[first:].any(axis=1))
        found = ((int(row), *self._refused(made, int(row), bound)) for row in missed)
        row, wrong, in_reach = next((one for one in found if one[1]), (-1, "", False))
        if not wrong:
            return made, ""
        kept = row + 1 if row == first and begins and in_reach else row
        if kept <= first:
            raise PolicyError(wrong)
        met = IkResult(
            solved.q[:kept], solved.position_error[:kept], solved.rotation_error[:kept], solved.flags[:kept]
        )
        cut = replace(made, rows=made.rows[:kept], source_rows=made.source_rows[:kept], ik_result=met)
        return cut, _ROWS_REFUSED(wrong=wrong, kept=kept - first)

    def _refused(self, made: CommandRows, row: int, bound: MissBound) -> tuple[str, bool]:
        """Why that row is, "" where it is not, and whether any joints meet it."""
        free, distance = self._spaces.meet(made, row)
        over = bound.misses(free)[0]
        if over.any():
            arm = int(over.argmax())
            return _OUT_OF_REACH(
                row=made.source_rows[row],
                arm=self._spaces.arm_names[arm],
                mm=1000.0 * free.position_error[0, arm],
                deg=np.degrees(free.rotation_error[0, arm]),
                allowed_mm=1000.0 * bound.position,
                allowed_deg=np.degrees(bound.rotation),
            ), False
        if distance > bound.jump:
            return _TOO_FAR(row=made.source_rows[row], distance=distance, allowed=bound.jump), True
        return "", True

    def check_measured_poses(self, answered: PolicyResponse) -> None:
        """Hold the poses that the robot measures against those of its joints: they may be of another frame.

        Raises SetupError where the policy depends on them; else it is only said.
        """
        shown = answered.observation
        if answered.eef != "measured" or shown.eef is None:
            return
        wrong = self._spaces.pose_mismatch(shown.eef, shown.qpos)
        if wrong and self.policy.uses_poses:
            raise SetupError(_EEF_DISAGREES(wrong=wrong))
        if wrong:
            self.notes.append(Event("eef_disagrees", wrong, self._clock.now(), shown.step))

    def log_ik_problems(self, answered: PolicyResponse) -> None:
        """Say what could not be done of an answer."""
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
    """Rows of which any arm is flagged, by flag, and the worst errors [mm, degrees]."""

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
