"""One question to the policy: what it is shown, where the call is made, what its answer means in commands."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace

from runtime.clock import Clock
from runtime.messages import Event
from runtime.policies.base import Policy
from runtime.runner import Runner
from runtime.sight import Sight
from runtime.spaces import CommandRows, Spaces
from runtime.types import ActionChunk, Conditioning, Observation

Committed = Callable[[int], Conditioning | None]  # by the step of the observation


@dataclass(frozen=True, slots=True)
class Answered:
    """An inference that came back: the chunk, how long it took [s], what it was asked about, what it means.

    `made` are its rows in command space. `waited`: the robot stood meanwhile.
    """

    chunk: ActionChunk
    seconds: float
    observation: Observation
    made: CommandRows
    waited: bool = False
    age: float | None = None  # of the oldest stream of the observation when the policy was asked [s]


class Asking:
    """Asks one policy; calls are made one after the other, and nobody waits for them here.

    Kinematics belong to the call: for a chunk of poses they take as long as a small model, and main must not.
    """

    def __init__(
        self, policy: Policy, task: str, spaces: Spaces, sight: Sight, runner: Runner, clock: Clock
    ) -> None:
        self.policy = policy
        self.task = task
        self.runner = runner
        self.sight = sight
        self._spaces = spaces
        self._clock = clock
        self._fresh = True
        self.notes: list[Event] = []  # for main to collect

    def exchange(self, policy: Policy, task: str) -> None:
        """Ask `policy`, with the instruction `task`, from now on.

        Another policy takes the place of the former one, which is closed first. Calls are made one after the
        other: the new one is reached when the last call of the former one is over, and nobody waits for that.
        """
        if policy is not self.policy:
            self.policy.close()
            self.policy, self._fresh = policy, True
        self.task = task

    def forget(self) -> None:
        """Let the policy forget the episode before its next inference."""
        self._fresh = True

    def observe(self) -> Observation:
        """What the policy would be shown now; PolicyError where there is nothing, or it is old."""
        return self.sight.now(self.task)

    def ask(self, waited: bool = False, committed: Committed | None = None) -> Future[Answered]:
        """Send one request about the newest observation; raises PolicyError where that is too old."""
        observation = self.observe()
        conditioning = committed(observation.step) if committed else None
        policy, fresh, self._fresh = self.policy, self._fresh, False

        def infer() -> Answered:
            if fresh:
                policy.reset()
            begun = self._clock.now()
            shown = observation
            if shown.eef is None:
                shown = replace(shown, eef=self._spaces.eef_of(shown.qpos))
            age = self._clock.now() - min(shown.captured.values())
            chunk = policy.infer(shown, conditioning)
            seconds = self._clock.now() - begun
            return Answered(chunk, seconds, shown, self._spaces.to_command(chunk, shown), waited, age)

        return self.runner.submit(infer)

    def note(self, answered: Answered) -> None:
        """Say what could not be done of an answer."""
        made = answered.made
        if made.solved is not None and not made.solved.reached.all():
            missed = int((~made.solved.reached).any(axis=1).sum())
            worst = float(made.solved.position_error.max()) * 1000
            text = f"{missed} of {len(made.rows)} poses are out of reach, the worst by {worst:.1f} mm: nearest taken"
            self.notes.append(Event("ik_unreached", text, self._clock.now(), answered.observation.step))
