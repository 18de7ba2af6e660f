"""Real-time chunking (RTC): rows that a request declares as fixed must be exactly those that control plans.

A complete station runs on the virtual clock, with a robot that reaches each command at once, and a policy whose answers
disagree with each other and which either honours the contract of real-time chunking or does not. Answers are late or
lost at random, and the run is halted, resumed, tuned and restarted.
"""

from __future__ import annotations

import math
import tempfile
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.strategy_station import InstantRobot, lockstep_deployment, station_of
from robots import Robot
from runtime.config import loader
from runtime.core.clock import Clock, VirtualClock
from runtime.core.errors import PolicyLostError
from runtime.core.types import EEF_WIDTH, ActionChunk, Conditioning, Float64, Observation
from runtime.ipc.session_state import SessionState
from runtime.kinematics.base import ChainForward
from runtime.motion.timeline import difference
from runtime.policies.base import Policy, PolicyInfo
from runtime.processes.coordinator.inference.runners import LockstepRunner
from runtime.processes.lockstep.lockstep import Lockstep, LockstepEnvironment
from runtime.spaces.end_effectors import EndEffectors
from runtime.station.checks import check_deployment
from runtime.station.spec import StationSpec

_TICKS = 240
_HAIR = 1e-6  # [steps] tolerance
_ROUNDING = 2e-5  # [rad, m] float32 conversion through the model's own numbers
_POSES = 2e-3  # [m, and quaternion components] tolerance of inverse kinematics
_ROBOTS = ("agilex_piper", "ur5e", "r1_lite", "arx_r5", "dual_franka", "agibot_g2")
_KINDS = ("rtc", "rtc", "rtc", "async", "naive", "ensemble", "sync")


@dataclass(frozen=True, slots=True)
class Scenario:
    """Parameters of a scenario."""

    robot: str
    control_hz: float
    action_hz: float | None  # None: the control rate
    horizon: int
    space: str
    own: bool  # the server returns rows in the model's own space
    keeps: bool  # the server honours the contract
    endless: bool  # one joint has no limits, and crosses half a turn
    wander: float  # [rad] disagreement of answers
    delay: tuple[int, int]  # [ticks] least and most
    lost: float  # share of the answers
    seen_every: int  # ticks per observation
    strategy: dict[str, Any]


def scenario(seed: int) -> Scenario:
    """Return the parameters of the scenario of `seed`."""
    random = np.random.default_rng(seed)
    control = float(random.choice([20.0, 30.0, 50.0]))
    least = int(random.integers(1, 6))
    most = least + int(random.integers(0, 7))
    horizon = int(random.integers(most + 3, 41))
    strategy: dict[str, Any] = {"kind": "rtc", "blend_window": int(random.integers(1, 13))}
    if random.random() < 0.1:
        strategy["blend_window"] = "all"
    if random.random() < 0.2:
        strategy["k_max"] = int(random.integers(0, 8))
    if random.random() < 0.3:
        strategy["execution_horizon"] = int(random.integers(most + 2, horizon + 1))
    if random.random() < 0.3:
        strategy["inference_rate"] = float(random.choice([2.0, 5.0, 10.0]))
    eef = random.random() < 0.15
    if eef:  # targets must be reachable: no jumps
        strategy = {"kind": "rtc", "blend_window": int(random.integers(4, 13))}
    rate = float(random.choice([10.0, 15.0, 24.0, 60.0])) if random.random() < 0.35 else None
    return Scenario(
        robot=str(random.choice(_ROBOTS[:2] if eef else _ROBOTS)),
        control_hz=control,
        action_hz=rate,
        horizon=horizon if rate is None else math.ceil(horizon * rate / control) + 1,
        space="eef" if eef else "joint",
        own=not eef and random.random() < 0.5,
        keeps=random.random() < 0.7,
        endless=not eef and random.random() < 0.2,
        wander=float(random.choice([0.01, 0.04] if eef else [0.01, 0.04, 0.15])),  # poses must be reachable
        delay=(least, most),
        lost=0.1 if random.random() < 0.3 else 0.0,
        seen_every=int(random.choice([1, 1, 2])),
        strategy=strategy,
    )


def once(seed: int) -> list[str]:
    """Run the scenario of `seed` on the virtual clock; return each violation as a sentence."""
    case, random = scenario(seed), np.random.default_rng([seed, 1])
    with tempfile.TemporaryDirectory() as folder:
        spec = _plan(Path(folder), case)
        keeper = PrefixKeepingPolicy(case, spec, random)
        planned = _run(spec, case, keeper, random)
    return [f"seed {seed}: {text}" for text in _violations(case, keeper, planned)]


class RandomDelayRunner(LockstepRunner):
    """Runner that delivers each result after a random number of ticks."""

    def __init__(self, least: int, most: int, random: np.random.Generator) -> None:
        super().__init__(least)
        self._least, self._most, self._random = least, most, random

    def submit(self, call: Any) -> Any:
        """Submit a call with a random delay."""
        self._delay = int(self._random.integers(self._least, self._most + 1))
        return super().submit(call)


class SlowlyObservedRobot(InstantRobot):
    """Robot that starts at `position`, and sends an observation only every few ticks."""

    def __init__(self, robot: Robot, clock: Clock, position: Float64, every: int) -> None:
        super().__init__(robot, clock)
        self.position = position
        self._every, self._looked = every, 0

    def receive(self, timeout: float) -> Observation | None:
        """Return an observation if one is due at the robot's own rate, else None."""
        self._looked += 1
        return super().receive(timeout) if self._looked % self._every == 0 else None


@dataclass(frozen=True, slots=True)
class DeclaredPrefix:
    """Rows [d, W] that a request declared as fixed; the first is for control step `step`."""

    step: int
    rows: Float64


class PrefixKeepingPolicy(Policy):
    """Policy that moves around a fixed posture, and continues the committed rows if it honours the contract."""

    def __init__(self, made: Scenario, spec: StationSpec, random: np.random.Generator) -> None:
        self._made, self._random = made, random
        self._robot = spec.robot
        self._eef = EndEffectors(spec.robot, ChainForward(spec.robot))
        self.stands = spec.robot.poses["ready"].astype(np.float64)
        if made.endless:
            self.stands[0] = np.pi - 0.02
        self._scale = random.uniform(0.3, 3.0, spec.robot.dim)
        self._shift = random.uniform(-1.0, 1.0, spec.robot.dim)
        self._switched = [] if made.space == "eef" else list(spec.robot.binary_dims)
        self.declared: list[DeclaredPrefix] = []

    def connect(self) -> PolicyInfo:
        """Return the policy's properties; there is no server."""
        return PolicyInfo("keeper", horizon=self._made.horizon, rate=self._made.action_hz, supports_rtc=True)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return random rows around the robot's posture.

        If the scenario says that this policy keeps its prefix, the rows begin with the committed rows of the request.

        Raises:
            PolicyLostError: At random.
        """
        rows = self._wandering(observation)
        if conditioning is not None:
            fixed = conditioning.remaining_rows[: conditioning.predicted_delay].astype(np.float64)
            left = self._joints(conditioning.remaining_rows.astype(np.float64))
            self.declared.append(DeclaredPrefix(observation.step, self._joints(fixed)))
            if self._made.keeps:
                rows = self._continued(rows, left, len(fixed))
        if self.declared and self._random.random() < self._made.lost:
            raise PolicyLostError("the answer is lost on purpose")
        own = self._model(rows).astype(np.float32) if self._made.own else None
        actions = rows if own is None else self._joints(own.astype(np.float64))
        return ActionChunk(
            actions.astype(np.float32),
            "eef" if self._made.space == "eef" else "joint",
            rate=self._made.action_hz,
            model_actions=own,
        )

    def reset(self) -> None:
        """Do nothing, because there is no state."""

    def close(self) -> None:
        """Do nothing, because there are no resources."""

    def apart(self, row: Float64, at: float, planned: dict[int, Float64], missed: float) -> str:
        """Return as text how a fixed row for control step `at` deviates from the plan, "" if it does not.

        If `at` is between two steps, the row is compared with the interpolation of their planned rows, and the plan's
        curvature is tolerated. For poses, the error `missed` of inverse kinematics is tolerated too.
        """
        before, part = math.floor(at + _HAIR), at - math.floor(at + _HAIR)
        steps = [before, before + 1] if part > _HAIR else [before]
        missing = [step for step in steps if step not in planned]
        if missing:
            return f"is for step {missing[0]}, for which nothing was planned"
        rows = np.array([self._of(planned[step]) for step in steps])
        expected = rows[0] + (part * self._difference(rows[-1], rows[0]) if len(rows) > 1 else 0.0)
        off = np.abs(self._difference(row, expected))
        allowed = np.full(len(off), _POSES + missed if self._made.space == "eef" else _ROUNDING)
        if len(rows) > 1:
            allowed += 2.0 * self._bend(before, planned)
        off[self._switched] = 0.0
        worst = int(np.argmax(off - allowed))
        if off[worst] <= allowed[worst]:
            return ""
        return f"is {off[worst]:.2e} off in number {worst}, allowed {allowed[worst]:.2e}"

    def _bend(self, before: int, planned: dict[int, Float64]) -> Float64:
        """Return the curvature of the plan around a step: the largest second difference of the planned rows there."""
        rows = [self._of(planned[step]) for step in range(before - 2, before + 4) if step in planned]
        steps = [self._difference(later, sooner) for sooner, later in pairwise(rows)]
        bends = [np.abs(later - sooner) for sooner, later in pairwise(steps)]
        return np.max(bends, axis=0, initial=0.0) if bends else np.zeros(len(rows[0]))

    def _of(self, joints: Float64) -> Float64:
        """Return planned joints in the space of the policy's rows: as joints, or converted to poses."""
        return self._eef.eef_of(joints).astype(np.float64) if self._made.space == "eef" else joints

    def _difference(self, left: Float64, right: Float64) -> Float64:
        if self._made.space == "eef":  # quaternions with the nearer sign
            left, right = left.reshape(*left.shape[:-1], -1, EEF_WIDTH).copy(), right.reshape(-1, EEF_WIDTH)
            turns = left[..., 3:7]
            turns *= np.where((turns * right[..., 3:7]).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
            return (left - right).reshape(-1)
        return difference(left, right, (0,) if self._made.endless else ())

    def _wandering(self, observation: Observation) -> Float64:
        """Return a random smooth path around the robot's posture.

        Quaternions have the signs that a policy server would send.
        """
        robot, random = self._robot, self._random
        rate = self._made.action_hz or self._made.control_hz
        seconds = observation.step / self._made.control_hz + np.arange(self._made.horizon) / rate
        phases = random.uniform(0.0, 2.0 * np.pi, robot.dim)
        joints = self.stands + self._made.wander * np.sin(2.0 * seconds[:, None] + phases)
        joints[:, list(robot.gripper_dims)] = self.stands[list(robot.gripper_dims)]
        if self._made.space == "eef":
            return self._eef.eef_of(joints).astype(np.float64)
        for dim in robot.binary_dims:
            joints[:, dim] = random.choice([robot.lower[dim], robot.upper[dim]])
        if self._made.endless:
            joints[:, 0] = (joints[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
        return np.asarray(joints)

    def _continued(self, rows: Float64, left: Float64, fixed: int) -> Float64:
        """Return `rows` with the first `fixed` ones replaced by those of `left`.

        The next 6 rows are a transition from `left` to the policy's own rows.
        """
        count = min(len(left), len(rows), fixed + 6)
        weights = np.clip((fixed + 6 - np.arange(count)) / 7.0, 0.0, 1.0)
        weights[:fixed] = 1.0
        for place in range(count):
            rows[place] += weights[place] * self._difference(left[place], rows[place])
        rows[:fixed] = left[:fixed]
        return rows

    def _model(self, joints: Float64) -> Float64:
        return (joints - self._shift) / self._scale

    def _joints(self, rows: Float64) -> Float64:
        return rows * self._scale + self._shift if self._made.own else rows


def _plan(data: Path, case: Scenario) -> StationSpec:
    tree = lockstep_deployment(data, case.robot, case.strategy, case.control_hz)
    tree["faults"] = {"policy_lost": "slow", "patience_s": 1000.0}
    planned = check_deployment(loader.resolve_deployment(tree, {}, "prefix"))
    robot = planned.robot
    if case.endless:
        lower, upper = robot.lower.copy(), robot.upper.copy()
        lower[0], upper[0] = -np.inf, np.inf
        robot = replace(robot, lower=lower, upper=upper)
    return replace(planned, robot=robot)


@dataclass(slots=True)
class Planned:
    """Record of a run, by control step.

    `rows` has the planned action of each step, before safety. `held` are the steps without a run, and `end` is the end
    of the run.
    """

    rows: dict[int, Float64]
    held: set[int]
    arrived: dict[int, int]  # by step of the observation: first step from which the answer is the plan
    other: set[int]  # steps with another strategy
    missed: dict[int, float]  # by step of the observation: largest error of poses [m, rad]
    end: int

    def arrived_for(self, step: int) -> int:
        """Return the first step at which the plan uses an answer to a request made at `step` or later.

        If no such answer arrived, return the end of the run, because an answer that was lost does not fix any row of
        the plan.
        """
        return min((at for observed, at in self.arrived.items() if observed >= step), default=self.end)

    def missed_before(self, step: int, horizon: int) -> float:
        """Return the largest error of inverse kinematics in answers that may contribute to this step or the
        next ones.
        """
        return max((off for at, off in self.missed.items() if step - 2 * horizon <= at <= step), default=0.0)


def _run(
    spec: StationSpec, case: Scenario, keeper: PrefixKeepingPolicy, random: np.random.Generator
) -> Planned:
    planned = Planned({}, set(), {}, set(), {}, 0)
    around, clock = LockstepEnvironment(runner=RandomDelayRunner(*case.delay, random)), VirtualClock()
    robot = SlowlyObservedRobot(spec.robot, clock, keeper.stands.copy(), case.seen_every)
    with closing(station_of(spec, robot, keeper, clock, around)) as station:
        session = station.coordinator.session
        station.connect()
        station.until(lambda: session.state is not SessionState.DISCONNECTED, 5.0, "first observation")
        station.command("setup")
        station.until(lambda: session.state is not SessionState.SETTING_UP, 60.0, "set-up")
        station.command("run")
        end = station.step + _TICKS

        def over() -> bool:
            status = station.shared.control.read()
            row, step = status["smoothed"].astype(np.float64), int(status["step"])
            if np.isfinite(row).all():
                planned.rows[step] = row
            if session.state is not SessionState.RUNNING:
                planned.held |= {step, step + 1}  # in the first of them, an unreported answer may be merged
            if not station.coordinator.inference.continues:
                planned.other.add(step + 1)
            displayed = station.coordinator.inference.shown
            if displayed is not None and displayed.state == "merged":
                used = displayed.targets[displayed.targets >= 0]
                worst = (
                    displayed.ik.get("worst_mm", 0.0) / 1e3,
                    math.radians(displayed.ik.get("worst_deg", 0.0)),
                )
                planned.missed[displayed.observation_step] = max(worst)
                planned.arrived.setdefault(displayed.observation_step, int(used[0]))
            return station.step >= end or random.random() < 0.02

        while station.step < end:
            station.until(over, 60.0, "the run")
            _interfere(station, case, random)
        planned.end = station.step - 1
    return planned


def _interfere(station: Lockstep, case: Scenario, random: np.random.Generator) -> None:
    """Do something at random that an operator might do now."""
    state = station.coordinator.session.state
    if state is SessionState.READY:
        station.command("run")
    elif state is SessionState.HOLDING:
        station.command("resume" if random.random() < 0.7 else "stop")
    elif state is SessionState.RUNNING and random.random() < 0.3:
        station.command("halt" if random.random() < 0.7 else "stop")
    elif state is SessionState.RUNNING:
        kind = str(random.choice(_KINDS))
        station.command("tune", strategy=case.strategy if kind == "rtc" else {"kind": kind})


def _violations(case: Scenario, keeper: PrefixKeepingPolicy, planned: Planned) -> list[str]:
    """Return each fixed row that differs from the plan for its step by more than the arithmetic tolerance, as a
    sentence.
    """
    problems: list[str] = []
    pace = (case.action_hz or case.control_hz) / case.control_hz
    binding = case.keeps and case.action_hz is None and "k_max" not in case.strategy
    for declared in keeper.declared:
        arrived = planned.arrived_for(declared.step)
        foreign = min((step for step in planned.other if step >= declared.step), default=planned.end)
        over = min(foreign, planned.end) if binding else arrived
        for place, row in enumerate(declared.rows):
            at = declared.step + place / pace
            steps = range(declared.step, math.ceil(at - _HAIR) + 1)
            if steps[-1] >= over or any(step in planned.held for step in steps):
                break  # the run was held, or an answer was merged that need not continue the prefix
            off = keeper.apart(row, at, planned.rows, planned.missed_before(declared.step, case.horizon))
            if off:
                problems.append(f"row {place} of the request about step {declared.step} ({case}) {off}")
    return problems
