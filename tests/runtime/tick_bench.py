"""A control tick with everything around it under the test's hand."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from runtime.config.schema import FaultResponse
from runtime.core.clock import VirtualClock
from runtime.core.types import Float64, Observation, RobotCommand
from runtime.ipc.messages import (
    Event,
    ExecutedTick,
    LockGrippers,
    MergeResult,
    Message,
    Order,
    PostedChunk,
    Tune,
    decode,
    encode,
)
from runtime.ipc.shared_state import EStop, SharedState, SharedStateLayout
from runtime.motion.timeline import DimensionKinds
from runtime.processes.control.chunk_execution import Strategy, build_strategy
from runtime.processes.control.tick import Tick, TickSettings
from runtime.safety.filter import Limits, SafetyFilter, SafetySettings
from runtime.safety.workspace import Workspace
from runtime.spaces.binary_grippers import BinaryGripper
from runtime.transports.base import Sink

PERIOD = 1 / 30
NO = np.zeros(2, bool)
TWO_JOINTS = Limits(("a", "b"), np.full(2, -2.0), np.full(2, 2.0), np.full(2, 3.0), NO, NO)
GRIPPER = np.array([False, False, True])
WITH_GRIPPER = Limits(
    ("a", "b", "gripper"),
    np.array([-2.0, -2.0, 0.0]),
    np.array([2.0, 2.0, 0.1]),
    np.array([3.0, 3.0, 1.0]),
    GRIPPER,
    np.zeros(3, bool),
)


class RecordingSink(Sink):
    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.told: list[tuple[str, dict[str, Any]]] = []
        self.takes_words = True

    def connect(self) -> None:
        pass

    def send(self, command: RobotCommand) -> None:
        self.sent.append(command.action.copy())

    def send_control_word(self, word: str, data: Any) -> None:
        if not self.takes_words:
            super().send_control_word(word, data)
        self.told.append((word, dict(data)))

    def close(self) -> None:
        pass


class Bench:
    """The robot goes at once where it is told, unless `moved_by_hand`; `feed` and `alive`: joints, coordinator.

    `chosen` is the strategy's section; further keywords are settings of safety. Before the first tick the robot has
    stood where it is for long enough to be believed, unless nobody has `seen` it.
    """

    def __init__(
        self,
        chosen: dict[str, Any] | None = None,
        limits: Limits = TWO_JOINTS,
        dims: DimensionKinds | None = None,
        starvation: FaultResponse = "slow",
        seen: bool = True,
        workspace: Workspace | None = None,
        switches: tuple[BinaryGripper, ...] = (),
        **safety: Any,
    ) -> None:
        self.limits, self.workspace = limits, workspace
        self.dim = len(limits.names)
        layout = SharedStateLayout(self.dim, 8, ("cam",), 300)
        shared = mmap.mmap(-1, SharedState.size(layout))
        self.shared, self.clock, self.sink = SharedState(layout, shared), VirtualClock(100.0), RecordingSink()
        self.shared.set_estop(EStop.CLEAR)
        self.step, self.order, self.sequence = 0, 0, 0
        self.dims = dims or DimensionKinds()
        self.chosen: Strategy = build_strategy(chosen or {"kind": "async"}, self.dims)
        self.safety = SafetySettings(**safety)
        self.starvation: FaultResponse = starvation
        self.switches = switches
        self.before_send: Callable[[], object] = lambda: None
        self.tick = self.new_tick()
        self.feed = self.alive = True
        self.moved_by_hand: Any = None
        self._begun = not seen
        self.measured = np.zeros(self.dim)

    @property
    def measured(self) -> Float64:
        """Where the robot is."""
        return self._measured

    @measured.setter
    def measured(self, measured: Float64) -> None:
        self._measured = measured
        if not self._begun:
            self.tick = self.new_tick()
            self._stand()

    def _stand(self) -> None:
        """Let the robot be seen where it is, with nothing else that happens."""
        for _ in range(5):
            self.observe()
            self.tick(self.step, self.clock.now())
            self.clock.advance(PERIOD)
        for ring in self.shared.rings.values():
            list(ring.drain())

    def new_tick(self) -> Tick:
        settings = TickSettings(
            period=PERIOD,
            limits=self.limits,
            dims=self.dims,
            safety=self.safety,
            heartbeat_timeout=lambda process: 1.0,
            starvation=self.starvation,
            starvation_hold=1.0,
            switches=self.switches,
        )
        safety = SafetyFilter(self.safety, self.limits, self._judged)
        return Tick(self.shared, self.sink, safety, self.chosen, settings, self.clock.now)

    def _judged(self, action: Float64) -> tuple[str, ...]:
        """Safety looks whether a policy's action leaves the workspace: the last moment before it is sent."""
        self.before_send()
        return self.workspace(action) if self.workspace else ()

    def observe(self, **changes: Any) -> None:
        self.sequence += 1
        now = self.clock.now()
        fields: dict[str, Any] = {
            "sequence": self.sequence,
            "arrived": now,
            "captured": {"joints": now, "cam": now},
            "qpos": self.measured.astype(np.float32),
            "pictures": {},
        }
        self.shared.publish_observation(Observation(**(fields | changes)), {"cam": self.sequence})

    # --- what the coordinator posts -----------------------------------------------------------------------------------

    def post(self, message: Message) -> None:
        assert self.shared.rings["orders"].push(encode(message))

    def say(self, kind: Any, **fields: Any) -> None:
        self.order += 1
        self.post(Order(self.order, kind, **fields))

    def chunk(
        self, number: int, rows: Any, step: int | None = None, run: int = 1, waited: bool = False
    ) -> None:
        step = self.step if step is None else step
        self.post(PostedChunk(number, run, step, np.asarray(rows, float), waited))

    def tune(self, kind: str, **section: Any) -> None:
        self.post(Tune({"kind": kind, **section}))

    def lock(self, *values: float) -> None:
        self.post(LockGrippers(np.array(values, float)))

    # --- time ----------------------------------------------------------------------------------------------

    def run(self, ticks: int = 1, stretch: float = 1.0) -> None:
        self._begun = True
        for _ in range(ticks):
            if self.alive:
                self.shared.beat("coordinator", self.clock.now())
                self.shared.beat("guard", self.clock.now())
            if self.feed:
                self.observe()
            self.tick(self.step, self.clock.now())
            self.step += 1
            self.clock.advance(PERIOD * stretch)
            self.move(PERIOD * stretch)

    def move(self, seconds: float) -> None:
        """Let the robot go on for so long."""
        if self.moved_by_hand is not None:
            self.measured = self.moved_by_hand
        elif self.sink.sent:
            self.measured = self.sink.sent[-1].astype(float)

    # --- what control tells --------------------------------------------------------------------------------

    def told(self) -> list[Event | MergeResult]:
        """Everything that the coordinator was told since the last call."""
        messages = [decode(payload) for payload in self.shared.rings["control_events"].drain()]
        return [message for message in messages if isinstance(message, Event | MergeResult)]

    def said(self, kind: str | None = None, quiet: Sequence[str] = ("limited", "limited_sum")) -> list[Event]:
        """The events since the last call: of `kind`, or all but the `quiet` ones."""
        events = [message for message in self.told() if isinstance(message, Event)]
        return [
            event for event in events if (event.kind not in quiet if kind is None else event.kind == kind)
        ]

    def records(self) -> list[ExecutedTick]:
        payloads = map(decode, self.shared.rings["ticks"].drain())
        return [message for message in payloads if isinstance(message, ExecutedTick)]

    @property
    def status(self) -> Any:
        return self.shared.control.read()

    @property
    def behaviour(self) -> str:
        return bytes(self.status["behaviour"]).decode()

    @property
    def sent(self) -> Float64:
        """Everything that the robot was told [N, D]."""
        return np.array(self.sink.sent, np.float64).reshape(-1, self.dim)


def wave(count: int, speed: float = 0.5, start: float = 0.0, dim: int = 2) -> Float64:
    """Rows [count, dim] that all joints go at `speed` [rad/s]."""
    return np.column_stack([start + speed * PERIOD * np.arange(count)] * dim)


def following(bench: Bench, rows: Any = None, **order: Any) -> Bench:
    """The bench one tick into a run that executes `rows`."""
    bench.say("follow", run=1, **order)
    bench.chunk(1, wave(60, dim=bench.dim) if rows is None else rows)
    bench.run()
    return bench
