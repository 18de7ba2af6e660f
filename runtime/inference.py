"""From observations to chunks: when the query half says so, ask the policy and post the answer to control."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from runtime.clock import Clock
from runtime.errors import PolicyError, RuntimeFault
from runtime.messages import ChunkMerged, Event, PolicyAnswer, PostedChunk
from runtime.orders import Orders
from runtime.page import Page
from runtime.policies.base import Policy
from runtime.spaces import Spaces
from runtime.strategies.base import Progress, Query
from runtime.timeline import resample
from runtime.types import ActionChunk, Float64, Observation

log = logging.getLogger(__name__)
Result = TypeVar("Result")


class StaleObservationError(PolicyError):
    """The newest observation is too old to ask a policy about."""


class Runner(ABC):
    """Where blocking calls to the policy are made, one after the other."""

    @abstractmethod
    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        """Start `call`; its result or RuntimeFault is in the future when `ready` says so."""

    @abstractmethod
    def ready(self, future: Future[Result]) -> bool: ...

    @property
    @abstractmethod
    def busy(self) -> bool:
        """Whether an earlier call is still being made, and another would wait behind it."""

    def tick(self) -> None:  # noqa: B027  # only runners that count have something to do
        """One control period has passed."""

    def close(self) -> None:  # noqa: B027  # only runners with a thread have something to do
        """Take no further calls."""


def _told(call: Callable[[], Result]) -> Callable[[], Result]:
    """`call`, with every error of a policy's own code told as a PolicyError: it must not end main."""

    def telling() -> Result:
        try:
            return call()
        except RuntimeFault:
            raise
        except Exception as error:
            log.exception("the policy's own code failed")
            raise PolicyError(f"the policy's own code failed: {type(error).__name__}: {error}") from error

    return telling


class ThreadRunner(Runner):
    """One thread of its own, so that a slow policy never stops main."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="policy")
        self._newest: Future[Any] | None = None

    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        future = self._pool.submit(_told(call))
        self._newest = future
        return future

    def ready(self, future: Future[Result]) -> bool:
        return future.done()

    @property
    def busy(self) -> bool:
        return self._newest is not None and not self._newest.done()

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)


class LockstepRunner(Runner):
    """Calls at once and hands the result over `delay` ticks later, the same on every run."""

    def __init__(self, delay: int) -> None:
        self._delay = delay
        self._now = 0
        self._due: WeakKeyDictionary[Future[Any], int] = WeakKeyDictionary()

    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        future: Future[Result] = Future()
        try:
            future.set_result(_told(call)())
        except RuntimeFault as error:
            future.set_exception(error)
        self._due[future] = self._now + self._delay
        return future

    def ready(self, future: Future[Result]) -> bool:
        return self._now >= self._due[future]

    @property
    def busy(self) -> bool:
        return False

    def tick(self) -> None:
        self._now += 1


@dataclass(frozen=True, slots=True)
class Answered:
    """An inference that came back: the chunk, how long it took [s], what it was asked about."""

    chunk: ActionChunk
    seconds: float
    observation: Observation


@dataclass(frozen=True, slots=True)
class InferenceSettings:
    """What inference goes by."""

    control_rate: float
    task: str
    joint_age: float
    picture_age: float
    switched: tuple[int, ...]  # binary dimensions
    stale_patience: float  # [s] without a fresh observation until waiting for one is an error


class Inference:
    """Asks the policy during a run and posts what it answers; one request in flight."""

    def __init__(
        self,
        policy: Policy,
        query: Query,
        spaces: Spaces,
        page: Page,
        orders: Orders,
        runner: Runner,
        clock: Clock,
        settings: InferenceSettings,
    ) -> None:
        self.policy = policy
        self.runner = runner
        self._query = query
        self._spaces = spaces
        self._page = page
        self._orders = orders
        self._clock = clock
        self._settings = settings
        self._run = 0
        self._fresh = True
        self._flight: Future[Answered] | None = None
        self._unmerged: dict[int, Float64] = {}  # by chunk: the rows that were posted
        self._raw: tuple[np.ndarray, Float64] | None = None  # of the newest merged chunk: its steps, its rows
        self._stale_since: float | None = None
        self._asked_at = float("-inf")
        self.latencies: deque[float] = deque(maxlen=200)  # [s]
        self.delays: deque[int] = deque(maxlen=200)  # control steps
        self.notes: list[Event] = []  # for main to collect

    def exchange(self, policy: Policy, task: str) -> None:
        """Ask `policy`, with the instruction `task`, from now on; figures are counted anew.

        Another policy takes the place of the former one, which is closed first. Calls are made one after the
        other: the new one is reached when the last call of the former one is over, and nobody waits for that.
        """
        self.pause()
        if policy is not self.policy:
            self.policy.close()
            self.policy, self._fresh = policy, True
        self._settings = replace(self._settings, task=task)
        self.latencies.clear()
        self.delays.clear()

    # --- asking --------------------------------------------------------------------------------------------

    def observe(self) -> Observation:
        """The newest observation as the policy is shown it; PolicyError where there is none, or it is old."""
        seen = self._page.read_observation(self._page.layout.cameras)
        if seen is None:
            raise PolicyError("no observation has arrived yet")
        now, bounds = self._clock.now(), self._settings
        for stream, captured in seen.captured.items():
            allowed = bounds.joint_age if stream in ("joints", "eef") else bounds.picture_age
            if not now - captured <= allowed:
                raise StaleObservationError(f"{stream}: {now - captured:.2f} s old, allowed {allowed:g}")
        missing = [camera for camera in self._page.layout.cameras if camera not in seen.pictures]
        if missing:
            raise PolicyError(f"no picture has arrived from {', '.join(missing)}")
        return replace(seen, step=self._step_of(seen), prompt=self._settings.task)

    def _step_of(self, seen: Observation) -> int:
        """The control step that an observation is assembled for: the tick that saw it, or the next one.

        While control stalls that is more than one step on: steps follow the clock, missed ticks are skipped.
        """
        status = self._page.control.read()
        step, planned = int(status["step"]), float(status["planned"])
        if seen.sequence == int(status["sequence"]):
            return step
        periods = (seen.arrived - planned) * self._settings.control_rate if planned else 1.0
        return step + max(1, math.ceil(periods - 1e-6))

    def ask(self) -> Future[Answered]:
        """Send one request about the newest observation; raises PolicyError where that is too old."""
        observation = self.observe()
        policy, fresh, self._fresh = self.policy, self._fresh, False
        return self.runner.submit(lambda: self._infer(policy, observation, fresh))

    def _infer(self, policy: Policy, observation: Observation, fresh: bool) -> Answered:
        if fresh:
            policy.reset()
        begun = self._clock.now()
        if observation.eef is None:
            observation = replace(observation, eef=self._spaces.eef_of(observation.qpos))
        chunk = policy.infer(observation)
        return Answered(chunk, self._clock.now() - begun, observation)

    def command_rows(self, answered: Answered) -> tuple[Float64, np.ndarray]:
        """The answer as rows in command space at control rate, and the policy row each was made from."""
        rows, solved = self._spaces.to_command(answered.chunk, answered.observation.qpos)
        if solved is not None and not solved.reached.all():
            missed = int((~solved.reached).any(axis=1).sum())
            worst = float(solved.position_error.max()) * 1000
            text = (
                f"{missed} of {len(rows)} poses are out of reach, the worst by {worst:.1f} mm: nearest taken"
            )
            self.notes.append(Event("ik_unreached", text, self._clock.now(), answered.observation.step))
        rate = answered.chunk.rate or self._settings.control_rate
        return resample(rows, rate, self._settings.control_rate, self._settings.switched)

    # --- a run ---------------------------------------------------------------------------------------------

    def begin(self, run: int, fresh: bool) -> None:
        """Ask from now on, for this run; `fresh` lets the policy forget the episode before."""
        self._run = run
        self._fresh = self._fresh or fresh
        self._stale_since = None
        self._unmerged.clear()
        self._asked_at = float("-inf")

    def pause(self) -> None:
        """Stop asking; an answer still in flight is ignored."""
        self._run = 0
        self._flight = None
        self._raw = None
        self._unmerged.clear()

    def merged(self, merged: ChunkMerged) -> None:
        """Control has put a chunk on the timeline, or dropped it."""
        rows = self._unmerged.pop(merged.chunk_id, None)
        if merged.run == self._run:
            self.delays.append(merged.delay)
            if rows is not None and not merged.dropped:
                self._raw = (merged.targets, rows)

    def raw(self, step: int) -> Float64 | None:
        """What the newest chunk that control has merged wants for `step` [D]; None where it says nothing of it."""
        if self._raw is None:
            return None
        steps, rows = self._raw
        meant = np.flatnonzero(steps == step)
        return rows[meant[-1]] if len(meant) else None

    def pump(self) -> PolicyAnswer | None:
        """Collect an answer, or ask; returns the answer, for the record. Raises PolicyError."""
        if not self._run:
            return None
        if self._flight is not None:
            if not self.runner.ready(self._flight):
                return None
            flight, self._flight = self._flight, None
            return self._post(flight.result())
        # A late answer of an earlier run may keep the policy busy: a request would grow old in the queue.
        if not self.runner.busy and self._query.wants(self._progress()) and self._try_to_ask():
            return self.pump()
        return None

    def _try_to_ask(self) -> bool:
        """Ask; True where the answer is there at once.

        A gap in the observations is control's to judge, action by action. But while a strategy waits for this
        answer there is nothing to judge, so a gap that lasts is an error here too.
        """
        now = self._clock.now()
        try:
            flight = self.ask()
        except StaleObservationError:
            if self._stale_since is None:
                self._stale_since = now
            if now - self._stale_since > self._settings.stale_patience:
                raise
            return False
        self._stale_since, self._asked_at, self._flight = None, now, flight
        return self.runner.ready(flight)

    def _progress(self) -> Progress:
        remaining = int(self._page.control.read()["remaining"])
        return Progress(remaining, bool(self._unmerged), self._clock.now() - self._asked_at)

    def _post(self, answered: Answered) -> PolicyAnswer:
        rows, source = self.command_rows(answered)
        number = self._orders.next_chunk()
        step = answered.observation.step
        self._orders.post(PostedChunk(number, self._run, step, rows))
        self._unmerged[number] = rows
        self.latencies.append(answered.seconds)
        chunk = answered.chunk
        return PolicyAnswer(
            number, self._run, step, chunk.actions, chunk.space, source, answered.seconds * 1000.0
        )
