"""The whole station in lockstep beside the step loop: the same policy, the same delay, action for action."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reference import DIM, Reference, chunks_of, make_policy, with_disagreement
from benchmarks.step_loop import Policy as Answering
from benchmarks.step_loop import StepLoop
from robots import Robot
from runtime.config import loader
from runtime.core.clock import Clock, VirtualClock
from runtime.core.plugins import variants
from runtime.core.types import ActionChunk, Conditioning, Float32, Float64, Observation, RobotCommand
from runtime.ipc.session_state import SessionState
from runtime.policies.base import Policy, PolicyInfo
from runtime.processes.lockstep.lockstep import Lockstep, LockstepEnvironment, Peers
from runtime.station.checks import check_deployment
from runtime.station.spec import StationSpec
from runtime.transports.base import Capabilities, Sink, Source

_SCALE = 0.3  # of the reference: so slow that safety has nothing to change
_TICKS = 300


class InstantRobot(Source, Sink):
    """A robot that is at once where it is told to be."""

    def __init__(self, robot: Robot, clock: Clock) -> None:
        self._clock = clock
        self._keys = [camera.key for camera in robot.cameras]
        self._sequence = 0
        self.position = robot.poses["ready"].astype(np.float64)

    def connect(self) -> None:
        """Nothing to open."""

    def receive(self, timeout: float) -> Observation | None:
        """Present observation, with black pictures."""
        self._sequence += 1
        now = self._clock.now()
        return Observation(
            sequence=self._sequence,
            arrived=now,
            captured=dict.fromkeys(("joints", *self._keys), now),
            qpos=self.position.astype(np.float32),
            pictures=dict.fromkeys(self._keys, np.zeros((4, 4, 3), np.uint8)),
        )

    def send(self, command: RobotCommand) -> None:
        """Go there."""
        self.position = command.action.astype(np.float64)

    def close(self) -> None:
        """Nothing to release."""


class TablePolicy(Policy):
    """Answers by the number of control steps since the first observation after a reset."""

    def __init__(self, answer: Answering, horizon: int) -> None:
        self._answer = answer
        self._horizon = horizon
        self.first = -1

    def connect(self) -> PolicyInfo:
        """Nothing to reach."""
        return PolicyInfo("known", action_space="joint", horizon=self._horizon, supports_rtc=True)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """The rows for that step."""
        if self.first < 0:
            self.first = observation.step
        return ActionChunk(self._answer(observation.step - self.first, conditioning).astype(np.float32))

    def reset(self) -> None:
        """The next observation is the first."""
        self.first = -1

    def close(self) -> None:
        """Nothing to release."""


def station_of(
    spec: StationSpec,
    robot: InstantRobot,
    policy: Policy,
    clock: VirtualClock,
    around: LockstepEnvironment | None = None,
) -> Lockstep:
    """A station in lockstep with that robot and that policy in the place of its own."""
    spec = replace(spec, capabilities=Capabilities(moves_robot=True))
    peers = Peers(lambda spec, clock: robot, lambda spec, clock: robot, lambda spec, clock: policy)
    return Lockstep(spec, clock, around, peers)


@dataclass(frozen=True, slots=True)
class Case:
    """Task of both the station and the step loop; `inference_hz` None is back to back."""

    strategy: str
    control_hz: float
    inference_hz: float | None
    horizon: int
    delay: int

    @property
    def section(self) -> dict[str, Any]:
        """The strategy, as in a deployment file."""
        paced = {} if self.inference_hz is None else {"inference_rate": self.inference_hz}
        return {"kind": self.strategy, **paced}


def compare(case: Case) -> tuple[int, int]:
    """Count of the policy's actions planned by the station, and of those that the step loop has otherwise."""
    with tempfile.TemporaryDirectory() as folder:
        spec = _plan(Path(folder), case)
        start = spec.robot.poses["ready"].astype(np.float64)
        answer = _answer(start, case)
        first, planned = _run(spec, TablePolicy(answer, case.horizon))
    module = variants("runtime.strategies")[case.strategy]
    config = module.Config.model_validate(case.section)
    loop = StepLoop(module, config, answer, lambda number: case.delay, spec.rate, start, spec.dims)
    meant = [tick for tick in loop.run(_TICKS).executed if tick.makers]
    other = [
        tick
        for tick in meant
        if not np.array_equal(planned[first + tick.step], tick.action.astype(np.float32))
    ]
    return len(meant), len(other)


def _run(spec: StationSpec, policy: TablePolicy) -> tuple[int, Mapping[int, Float32]]:
    """The step of the run's first observation, and by control step what was planned, before safety."""
    planned: dict[int, Float32] = {}
    clock = VirtualClock()
    with closing(station_of(spec, InstantRobot(spec.robot, clock), policy, clock)) as station:
        session = station.coordinator.session
        station.connect()
        station.until(lambda: session.state is not SessionState.DISCONNECTED, 5.0, "first observation")
        station.command("setup")
        station.until(lambda: session.state is not SessionState.SETTING_UP, 60.0, "set-up")
        station.command("run")
        end = station.step + _TICKS + 1

        def over() -> bool:
            status = station.shared.control.read()
            planned[int(status["step"])] = status["smoothed"].copy()
            return station.step >= end

        station.until(over, 60.0, "the run")
        return policy.first, planned


def _answer(start: Float64, case: Case) -> Answering:
    """Policy of both: chunks that disagree, around `start`, in the float32 of the wire."""
    steps = np.arange(_TICKS + 4 * case.horizon, dtype=float)
    reference = Reference(case.control_hz)
    meant = with_disagreement(chunks_of(reference.at(steps) - reference.at(steps[:1]), case.horizon))

    def rows(step: int) -> Float64:
        made = np.tile(start, (case.horizon, 1))
        made[:, :DIM] += _SCALE * meant(step)
        return made

    known = make_policy(rows)
    return lambda step, given: known(step, given).astype(np.float32).astype(np.float64)


def lockstep_deployment(data: Path, robot: str, strategy: dict[str, Any], rate: float) -> dict[str, Any]:
    """The tables of a station on the virtual clock whose robot and policy are given to it; nothing is recorded."""
    return {
        "station": "strategies",
        "robot": robot,
        "data_dir": str(data),
        "task": "follow the reference",
        "transport": {"kind": "dataset", "path": "-"},
        "policy": {"kind": "mock"},
        "strategy": strategy,
        "control": {"rate": rate},
        "setup": {"home": False},
        "recording": {"enabled": False},
    }


def _plan(data: Path, case: Case) -> StationSpec:
    tree = lockstep_deployment(data, "agilex_piper", case.section, case.control_hz)
    tree["lockstep"] = {"delay_ticks": case.delay}
    return check_deployment(loader.resolve_deployment(tree, {}, "strategies"))
