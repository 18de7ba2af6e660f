"""Whole stations in lockstep around a robot and a policy under the test's hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from runtime.config import loader
from runtime.core.errors import PolicyError
from runtime.core.types import ActionChunk, Conditioning, Float64, Observation, RobotCommand, Space
from runtime.ipc.session_state import SessionState
from runtime.policies.base import Policy, PolicyInfo
from runtime.processes.lockstep.lockstep import Lockstep
from runtime.recording.reader import Episode, open_episode
from runtime.station.checks import checked_spec
from runtime.station.spec import StationSpec
from runtime.transports.base import Capabilities, Sink, Source
from tests.runtime.recording.samples import numbered

DIM = 14
MOVED = (0, 7)  # first joint of each arm: far from every limit
STANDS = np.tile([0.0, 0.8, -0.8, 0.0, 0.5, 0.0, 0.05], 2)  # a pose with room on all sides
Rows = Callable[[Observation, int], Any]


def ramp(first: int, count: int, speed: float = 0.002) -> Float64:
    """The positions for the steps from `first` on: [count, D], `speed` rad per step on two joints."""
    rows = np.tile(STANDS, (count, 1))
    rows[:, MOVED] += speed * (first + np.arange(count))[:, None]
    return rows


class StubRobot(Source, Sink):
    """Goes wherever it is told, at once; each observation shows its own number on every camera."""

    def __init__(self, spec: StubPlan, clock: Any) -> None:
        self._plan, self._clock = spec, clock
        self.position = spec.start.copy()
        self.commands: list[RobotCommand] = []
        self.blocked = False
        self.silent = False
        self.cameras = [camera.key for camera in spec.robot.cameras]
        self.picture = numbered
        self.bias: Float64 = np.zeros(DIM)  # it stands beside where it is told to go
        self.misread: Float64 = np.zeros(DIM)  # by how much its encoders are off
        self.told: list[tuple[str, dict[str, Any]]] = []
        self.wordless = not spec.simulated
        self.deaf = 0  # control words that are lost on their way to it
        self.truth: dict[str, Any] | None = None
        self.drives: dict[str, Any] | None = None
        self._sequence = 0

    def connect(self) -> None:
        pass

    def receive(self, timeout: float) -> Observation | None:
        if self.silent:
            return None
        self._sequence += 1
        now = self._clock.now()
        return Observation(
            sequence=self._sequence,
            arrived=now,
            captured=dict.fromkeys(("joints", *self.cameras), now),
            qpos=(self.position + self.misread).astype(np.float32),
            pictures=dict.fromkeys(self.cameras, self.picture(self._sequence)),
            truth=self.truth,
            drives=self.drives,
        )

    def send(self, command: RobotCommand) -> None:
        self.commands.append(command)
        if not self.blocked:
            self.position = command.action.astype(np.float64) + self.bias

    def tell(self, word: str, data: Mapping[str, Any]) -> None:
        if self.wordless:
            super().tell(word, data)
        self.told.append((word, dict(data)))
        if len(self.told) > self.deaf:
            self.truth = {"reset": data["id"], "seed": data["seed"], "milestones": {}, "success": False}

    def close(self) -> None:
        pass

    @property
    def sent(self) -> Float64:
        """All commands [N, D]."""
        return np.array([command.action for command in self.commands], np.float64).reshape(-1, DIM)


class StubPolicy(Policy):
    """Answers with what `rows(observation, number)` says; `number` counts the answers since the reset."""

    def __init__(self, spec: StubPlan) -> None:
        self._plan = spec
        self.calls: list[str] = []
        self.number = 0
        self.first: int | None = None  # step of the first observation since the reset

    def connect(self) -> PolicyInfo:
        self.calls.append("connect")
        if self._plan.absent:
            raise PolicyError(self._plan.absent)
        return PolicyInfo("stub")

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        self.calls.append("infer")
        if self.first is None:
            self.first = observation.step
        rows = self._plan.rows(replace(observation, step=observation.step - self.first), self.number)
        self.number += 1
        return ActionChunk(np.asarray(rows, np.float32), space=self._plan.space)

    def reset(self) -> None:
        self.calls.append("reset")
        self.number, self.first = 0, None

    def close(self) -> None:
        self.calls.append("close")


def on_time(observation: Observation, number: int) -> Float64:
    """For every step the position that the ramp has then."""
    return ramp(observation.step, 20)


@dataclass(frozen=True, slots=True)
class StubPlan(StationSpec):
    """A plan whose transport and policy are the test's; it keeps what it has built."""

    built: dict[str, Any]
    start: Float64
    rows: Rows
    space: Space
    absent: str
    moves_robot: bool
    simulated: bool

    @property
    def transport(self) -> Any:
        return SimpleNamespace(source=self._robot, sink=self._robot)

    @property
    def policy(self) -> Any:
        return SimpleNamespace(build=self._policy)

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(moves_robot=self.moves_robot, resets_bench=self.simulated)

    def _robot(self, config: object, robot: object, clock: object) -> StubRobot:
        if "robot" not in self.built:
            self.built["robot"] = StubRobot(self, clock)
        return self.built["robot"]

    def _policy(self, config: object, robot: object, clock: object, rate: float) -> StubPolicy:
        if "unfit" in self.built:
            raise self.built["unfit"]
        self.built["policy"] = StubPolicy(self)
        self.built.setdefault("policies", []).append(self.built["policy"])
        return self.built["policy"]


def spec_of(
    data: Path,
    rows: Rows = on_time,
    strategy: str = "async",
    delay: int = 0,
    start: Float64 = STANDS,
    space: Space = "joint",
    absent: str = "",
    moves_robot: bool = True,
    simulated: bool = False,
    **settings: Any,
) -> StubPlan:
    """A station on the bundled robot's description; `settings` are tables of the deployment."""
    tree: dict[str, Any] = {
        "station": "bench",
        "robot": "agilex_piper",
        "data_dir": str(data),
        "task": "stack the cups",
        "transport": {"kind": "dataset", "path": "-"},
        "policy": {"kind": "mock"},
        "strategy": {"kind": strategy},
        "setup": {"home": False},
        "recording": {"min_free_bytes": 0},
        "lockstep": {"delay_ticks": delay},
    }
    for table, values in settings.items():
        tree[table] = {**tree.get(table, {}), **values} if isinstance(values, dict) else values
    made = checked_spec(loader.resolve(tree, {}, "test"))
    return StubPlan(made.resolved, made.robot, {}, start, rows, space, absent, moves_robot, simulated)


class Station(Lockstep):
    """A lockstep station with its robot, its policy, and a few words for what tests do again and again."""

    def __init__(self, made: StubPlan) -> None:
        made.built.clear()
        super().__init__(made)
        self.robot: StubRobot = made.built["robot"]
        self.policy: StubPolicy = made.built["policy"]  # the deployment's own
        self.policies: list[StubPolicy] = made.built["policies"]  # all that were built since
        self.connect()

    @property
    def state(self) -> SessionState:
        return self.coordinator.session.state

    @property
    def reason(self) -> str:
        return self.coordinator.session.reason

    def go(self, ticks: int) -> None:
        """Tick under a lease that is kept."""
        left = self.step + ticks
        self.until(lambda: self.step >= left, ticks + 1.0, "ticks")

    def reach(self, state: SessionState, seconds: float = 30.0) -> None:
        self.until(lambda: self.state is state, seconds, f"{state}")

    def ready(self, **arguments: Any) -> Station:
        self.prepare(**arguments)
        assert self.state is SessionState.READY, self.reason
        return self

    def running(self, ticks: int = 30) -> Station:
        self.ready()
        self.command("run")
        self.go(ticks)
        return self

    def stop(self) -> Episode:
        """Stop, let the end go from the coordinator to media and back, and read what was recorded."""
        self.command("stop")
        self.go(3)
        return self.episode()

    def episode(self) -> Episode:
        return open_episode(Path(self.coordinator.runs.last_episode["path"]))

    def prepare(self, **arguments: Any) -> None:
        """Set up, to whatever end."""
        self.until(
            lambda: self.state in (SessionState.IDLE, SessionState.READY), 30.0, "a state to set up from"
        )
        self.command("setup", **arguments)
        self.until(lambda: self.state is not SessionState.SETTING_UP, 60.0, "set-up")

    def events(self, kind: str) -> list[str]:
        return [event["text"] for event in self.coordinator.events.since(0) if event["kind"] == kind]


def column(table: Any, name: str) -> np.ndarray:
    """A column of a table as an array."""
    return np.array(table[name].to_pylist())
