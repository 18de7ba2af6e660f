"""The two parts of a strategy, query and merge, in integer steps: request, delay, merge, one action per step.

The order is the same as in coordinator and control, but without processes, wire and safety, and with a robot that
reaches each command at once. A tick is: take an answer or send a request, merge, execute.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from runtime.core.types import ActionChunk, Conditioning, Float64
from runtime.ipc.messages import MergeResult
from runtime.motion.timeline import Contributions, DimensionKinds, Timeline
from runtime.processes.coordinator.inference.chunk_mixture import Mixture
from runtime.processes.coordinator.inference.rtc_prefix import RtcPrefix
from runtime.strategies.base import ArrivedChunk, Progress, StrategyParameters, join

Policy = Callable[[int, Conditioning | None], Float64]  # observation step, conditioning -> rows [H, D]
FAR = 0.05  # [rad] deviation of a run's first action that is not blended in, as in control


@dataclass(frozen=True, slots=True)
class Executed:
    """Executed step: the action, its contributions, and whether the plan was unexpectedly empty."""

    step: int
    action: Float64
    makers: Contributions  # () while the last target is held
    starved: bool


@dataclass(frozen=True, slots=True)
class _Request:
    number: int
    step: int
    due: int
    waited: bool
    rows: Float64


@dataclass(slots=True)
class Log:
    """Results of a step loop so far: executed steps, merged chunks, and the steps of their observations."""

    executed: list[Executed] = field(default_factory=list)
    merged: list[MergeResult] = field(default_factory=list)
    observed: dict[int, int] = field(default_factory=dict)  # by chunk: step of its observation


class StepLoop:
    """Run of a strategy; `delay` returns the delay of request number n (from 1) in ticks, `rate` is the control rate
    [Hz].
    """

    def __init__(
        self,
        strategy: ModuleType,
        config: StrategyParameters,
        policy: Policy,
        delay: Callable[[int], int],
        rate: float,
        start: Float64,
        dims: DimensionKinds | None = None,
    ) -> None:
        self._dims = DimensionKinds() if dims is None else dims
        self._policy = policy
        self._delay = delay
        self._rate = rate
        self.commanded = np.array(start, np.float64)
        self.timeline = Timeline(len(self.commanded))
        self.step = 0
        self.log = Log()
        self._flight: _Request | None = None
        self._number = 0
        self._asked = -1
        self._waiting = True  # for the first chunk: not starvation
        self._starved = False
        self._delays: deque[int] = deque(maxlen=50)
        self._commitment = RtcPrefix(rate, Mixture(self._dims))
        self._kind = ""
        self._joining = False
        self._merge: Any = None
        self.tune(strategy, config)

    def tune(self, strategy: ModuleType, config: StrategyParameters) -> None:
        """Use `strategy` with these parameters from the next tick on."""
        self._joining = self._joining or self._kind not in ("", strategy.__name__)
        self._kind = strategy.__name__
        waited = self.step > 0 and self._merge.requests_while_stopped
        self._config = config
        self._query = strategy.query(config)
        self._merge = strategy.merge(config, self._dims)
        if waited and not self.timeline.remaining(self.step):
            self._waiting = True  # the robot waits intentionally: the next chunk counts as a first one

    def run(self, ticks: int) -> Log:
        """Execute `ticks` control periods."""
        for _ in range(ticks):
            self.tick()
        return self.log

    def tick(self) -> None:
        """Execute one control period."""
        if self._flight is None and self._query.should_request(self._progress()):
            self._flight = self._ask()
        if self._flight is not None and self.step >= self._flight.due:
            request, self._flight = self._flight, None
            self._arrive(request)
        self._execute()
        self.step += 1

    def _progress(self) -> Progress:
        since = (self.step - self._asked) / self._rate if self._asked >= 0 else float("inf")
        return Progress(self.timeline.remaining(self.step), False, since)

    def _ask(self) -> _Request:
        self._number += 1
        self._asked = self.step
        conditioning = self._conditioning() if self._query.uses_rtc else None
        rows = self._policy(self.step, conditioning)
        self.log.observed[self._number] = self.step
        due = self.step + self._delay(self._number)
        return _Request(self._number, self.step, due, self._query.requests_while_stopped, rows)

    def _conditioning(self) -> Conditioning | None:
        """Return the conditioning that the coordinator would send to a policy with RTC."""
        quantile, horizon = self._config.delay_quantile, self._config.execution_horizon
        return self._commitment.conditioning(self.step, self._delays, quantile, horizon)

    def _arrive(self, request: _Request) -> None:
        arrival = ArrivedChunk(request.number, request.step, request.rows, request.waited)
        first = self._merge.place(self.timeline, arrival, self.step).rows[:1]
        far = self._waiting and np.abs(first - self.commanded).max(initial=0.0) > FAR
        start = self.commanded if (self._starved or far) and not self._merge.requests_while_stopped else None
        merged = join(
            self._merge,
            self.timeline,
            arrival,
            self.step,
            start,
            self._dims,
            joining=self._joining,
            commanded=self.commanded,
        )
        self._waiting = False
        self._delays.append(merged.delay)
        self.log.merged.append(merged)
        self._joining = self._joining and bool(merged.dropped)
        chunk = ActionChunk(request.rows.astype(np.float32))
        self._commitment.add_chunk(request.number, chunk, request.step, request.waited)
        self._commitment.on_merged(merged)

    def _execute(self) -> None:
        planned = self.timeline.at(self.step)
        self._starved = planned is None and not (self._merge.requests_while_stopped or self._waiting)
        if planned is not None:
            self.commanded = planned.action
        makers = () if planned is None else planned.contributions
        self.log.executed.append(Executed(self.step, self.commanded, makers, self._starved))
