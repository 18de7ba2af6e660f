"""Whole stations in lockstep around a robot and a policy under the test's hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from runtime.config import loader
from runtime.core.clock import Clock
from runtime.core.errors import PolicyError
from runtime.core.plugins import variants
from runtime.core.types import ActionChunk, Conditioning, Float64, Observation, RobotCommand, Space
from runtime.ipc.session_state import SessionState
from runtime.policies.base import Policy, PolicyInfo
from runtime.processes.coordinator.assembly import assemble
from runtime.processes.coordinator.builders import make_policy
from runtime.processes.lockstep.lockstep import Lockstep, Peers
from runtime.recording.reader import Episode, open_episode
from runtime.station.checks import check_deployment
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

    def __init__(self, stubs: Stubs, clock: Any) -> None:
        self._clock = clock
        self.position = stubs.start.copy()
        self.commands: list[RobotCommand] = []
        self.blocked = False
        self.silent = False
        self.cameras = [camera.key for camera in stubs.spec.robot.cameras]
        self.picture = numbered
        self.bias: Float64 = np.zeros(DIM)  # it stands beside where it is told to go
        self.misread: Float64 = np.zeros(DIM)  # by how much its encoders are off
        self.told: list[tuple[str, dict[str, Any]]] = []
        self.wordless = not stubs.spec.capabilities.bench
        self.simulates_factors = True
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

    def send_control_word(self, word: str, data: Mapping[str, Any]) -> None:
        if self.wordless:
            super().send_control_word(word, data)
        self.told.append((word, dict(data)))
        if len(self.told) > self.deaf:
            self.truth = {"reset": data["id"], "seed": data["seed"], "milestones": {}, "success": False}
            if self.simulates_factors and data.get("factors"):
                self.truth["factors"] = data["factors"]

    def close(self) -> None:
        pass

    @property
    def sent(self) -> Float64:
        """All commands [N, D]."""
        return np.array([command.action for command in self.commands], np.float64).reshape(-1, DIM)


class StubPolicy(Policy):
    """Answers with what `rows(observation, number)` says; `number` counts the answers since the reset."""

    def __init__(self, stubs: Stubs) -> None:
        self._stubs = stubs
        self.calls: list[str] = []
        self.number = 0
        self.first: int | None = None  # step of the first observation since the reset

    def connect(self) -> PolicyInfo:
        self.calls.append("connect")
        if self._stubs.absent:
            raise PolicyError(self._stubs.absent)
        return PolicyInfo("stub")

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        self.calls.append("infer")
        if self.first is None:
            self.first = observation.step
        rows = self._stubs.rows(replace(observation, step=observation.step - self.first), self.number)
        self.number += 1
        return ActionChunk(np.asarray(rows, np.float32), space=self._stubs.space)

    def reset(self) -> None:
        self.calls.append("reset")
        self.number, self.first = 0, None

    def close(self) -> None:
        self.calls.append("close")


def on_time(observation: Observation, number: int) -> Float64:
    """For every step the position that the ramp has then."""
    return ramp(observation.step, 20)


@dataclass
class Stubs:
    """A station's spec, and the robot and policy of the test's in the place of its own; keeps what it has built."""

    spec: StationSpec
    start: Float64 = field(default_factory=STANDS.copy)
    rows: Rows = on_time
    space: Space = "joint"
    absent: str = ""
    real: str = ""  # kind of policy that is what the deployment says
    unfit: Exception | None = None  # what making a policy ends with
    built: dict[str, Any] = field(default_factory=dict)

    @property
    def peers(self) -> Peers:
        return Peers(self.robot, self.robot, partial(make_policy, build=self.policy))

    def robot(self, spec: StationSpec, clock: Clock) -> StubRobot:
        made: StubRobot = self.built.setdefault("robot", StubRobot(self, clock))
        return made

    def policy(self, config: Any, *given: Any) -> Policy:
        if self.unfit is not None:
            raise self.unfit
        if config.kind == self.real:
            made: Policy = variants("runtime.policies")[self.real].build(config, *given)
        else:
            made = StubPolicy(self)
        self.built["policy"] = made
        self.built.setdefault("policies", []).append(made)
        return made


def stubbed(
    data: Path,
    rows: Rows = on_time,
    strategy: str = "async",
    delay: int = 0,
    start: Float64 = STANDS,
    space: Space = "joint",
    absent: str = "",
    moves_robot: bool = True,
    simulated: bool = False,
    bench: str = "tabletop",
    real: str = "",
    **settings: Any,
) -> Stubs:
    """A station on the bundled robot's description, stood in for; `settings` are tables of the deployment."""
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
    can = Capabilities(moves_robot=moves_robot, bench=bench if simulated else "")
    spec = replace(check_deployment(loader.resolve_deployment(tree, {}, "test")), capabilities=can)
    return Stubs(spec, start, rows, space, absent, real)


class Station(Lockstep):
    """A lockstep station with its robot, its policy, and a few words for what tests do again and again."""

    def __init__(self, stubs: Stubs) -> None:
        self.stubs = stubs
        stubs.built.clear()
        super().__init__(stubs.spec, peers=stubs.peers)
        self.robot: StubRobot = stubs.built["robot"]
        self.policy: StubPolicy = stubs.built["policy"]  # the deployment's own
        self.policies: list[StubPolicy] = stubs.built["policies"]  # all that were built since
        self.connect()

    def restart_coordinator(self) -> None:
        """Another coordinator in the place of this one, with what was shared."""
        self.coordinator = assemble(
            self.spec, self.shared, self.clock, self._runner, make_policy=self.stubs.peers.policy
        )

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
