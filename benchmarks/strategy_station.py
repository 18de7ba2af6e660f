"""Comparison of a complete station in lockstep with the step loop: same policy, same delay, action by action."""

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

_SCALE = 0.3  # of the reference: slow enough for safety to change nothing
_TICKS = 300


class InstantRobot(Source, Sink):
    """Robot that reaches each command at once."""

    def __init__(self, robot: Robot, clock: Clock) -> None:
        self._clock = clock
        self._keys = [camera.key for camera in robot.cameras]
        self._sequence = 0
        self.position = robot.poses["ready"].astype(np.float64)

    def connect(self) -> None:
        """Do nothing, because there is no connection."""

    def receive(self, timeout: float) -> Observation | None:
        """Return the current observation, with black images."""
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
        """Move to the command at once."""
        self.position = command.action.astype(np.float64)

    def close(self) -> None:
        """Do nothing, because there are no resources."""


class TablePolicy(Policy):
    """Policy whose answer depends only on the number of control steps since the first observation after a reset."""

    def __init__(self, answer: Answering, horizon: int) -> None:
        self._answer = answer
        self._horizon = horizon
        self.first = -1

    def connect(self) -> PolicyInfo:
        """Return the policy's properties; there is no server."""
        return PolicyInfo("known", action_space="joint", horizon=self._horizon, supports_rtc=True)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the rows for the observation's step."""
        if self.first < 0:
            self.first = observation.step
        return ActionChunk(self._answer(observation.step - self.first, conditioning).astype(np.float32))

    def reset(self) -> None:
        """Count the steps of the table from the next observation on."""
        self.first = -1

    def close(self) -> None:
        """Do nothing, because there are no resources."""


def station_of(
    spec: StationSpec,
    robot: InstantRobot,
    policy: Policy,
    clock: VirtualClock,
    around: LockstepEnvironment | None = None,
) -> Lockstep:
    """Return a station in lockstep, with `robot` and `policy` instead of those of the deployment."""
    spec = replace(spec, capabilities=Capabilities(moves_robot=True))
    peers = Peers(lambda spec, clock: robot, lambda spec, clock: robot, lambda spec, clock: policy)
    return Lockstep(spec, clock, around, peers)


@dataclass(frozen=True, slots=True)
class Case:
    """Parameters with which both the station and the step loop run.

    If `inference_hz` is None, each inference starts as soon as the previous one has ended.
    """

    strategy: str
    control_hz: float
    inference_hz: float | None
    horizon: int
    delay: int

    @property
    def section(self) -> dict[str, Any]:
        """Section of the strategy in a deployment file."""
        paced = {} if self.inference_hz is None else {"inference_rate": self.inference_hz}
        return {"kind": self.strategy, **paced}


def compare(case: Case) -> tuple[int, int]:
    """Compare the actions that a station plans with those of the step loop.

    Return the number of compared actions, and the number of those among them that differ.
    """
    with tempfile.TemporaryDirectory() as folder:
        spec = _plan(Path(folder), case)
        start = spec.robot.poses["ready"].astype(np.float64)
        answer = _answer(start, case)
        first, planned = _run(spec, TablePolicy(answer, case.horizon))
    module = variants("runtime.strategies")[case.strategy]
    config = module.Config.model_validate(case.section)
    loop = StepLoop(module, config, answer, lambda number: case.delay, spec.rate, start, spec.dims)
    planned_ticks = [tick for tick in loop.run(_TICKS).executed if tick.makers]
    station_ticks = [
        tick
        for tick in planned_ticks
        if not np.array_equal(planned[first + tick.step], tick.action.astype(np.float32))
    ]
    return len(planned_ticks), len(station_ticks)


def _run(spec: StationSpec, policy: TablePolicy) -> tuple[int, Mapping[int, Float32]]:
    """Return the step of the run's first observation, and the planned actions by control step, before safety."""
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
    """Return the policy that the station and the step loop both use.

    The policy answers with chunks around `start` [D] that disagree with each other. Its rows are rounded to float32, as
    they are in messages.
    """
    steps = np.arange(_TICKS + 4 * case.horizon, dtype=float)
    reference = Reference(case.control_hz)
    chunk_of = with_disagreement(chunks_of(reference.at(steps) - reference.at(steps[:1]), case.horizon))

    def rows(step: int) -> Float64:
        filled = np.tile(start, (case.horizon, 1))
        filled[:, :DIM] += _SCALE * chunk_of(step)
        return filled

    respond = make_policy(rows)
    return lambda step, given: respond(step, given).astype(np.float32).astype(np.float64)


def lockstep_deployment(data: Path, robot: str, strategy: dict[str, Any], rate: float) -> dict[str, Any]:
    """Return the deployment of a station on the virtual clock without recording.

    Its robot and its policy are replaced later.
    """
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
