"""Policy without a server: smooth, deterministic motion around the first observed joints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from runtime.core.clock import Clock
from runtime.core.errors import PolicyError
from runtime.core.settings import Settings
from runtime.core.types import ActionChunk, Conditioning, Float64, Observation
from runtime.policies.base import Policy, PolicyInfo

if TYPE_CHECKING:
    from robots import Robot


class Config(Settings):
    """Synthetic motion generated on this machine, for testing everything except a policy."""

    kind: Literal["mock"] = "mock"
    amplitude: float = Field(default=0.2, gt=0, le=1.0)
    """Distance that each joint moves from its first observed position [rad]; less if its limit is closer."""
    period_s: float = Field(default=6.0, ge=0.5, allow_inf_nan=False)
    """Duration of one motion out and back [s]."""
    horizon: int = Field(default=50, ge=1, le=10_000)
    """Rows per chunk, at the control rate."""
    latency_s: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    """Duration of each response [s], as a real wait on the clock."""


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> MockPolicy:
    """Create the policy, which needs no connection."""
    return MockPolicy(config, robot, clock, control_rate)


class MockPolicy(Policy):
    """Policy that moves each joint out and back as (1 - cos) / 2, starting at rest at the robot's joints.

    The motion depends on the control step alone: row i of the chunk for step s is for step s + i since the first
    observation after a reset. Grippers move half their travel; binary grippers stay.
    """

    def __init__(self, config: Config, robot: Robot, clock: Clock, control_rate: float) -> None:
        self._config = config
        self._robot = robot
        self._clock = clock
        self._control_rate = control_rate
        self._start: Float64 | None = None
        self._way: Float64 = np.zeros(robot.dim)
        self._first_step = 0

    def connect(self) -> PolicyInfo:
        """Return the policy's description; there is no server to connect to."""
        return PolicyInfo("mock", action_space="joint", horizon=self._config.horizon)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the next `horizon` rows of the motion, in joint space."""
        if observation.qpos.shape != (self._robot.dim,):
            raise PolicyError(
                f"the observation has joints of shape {list(observation.qpos.shape)}; "
                f"{self._robot.name} has [{self._robot.dim}]"
            )
        if self._start is None:
            self._begin(observation)
        rows = self._rows(max(0, observation.step - self._first_step))
        if self._config.latency_s:
            self._clock.sleep_until(self._clock.now() + self._config.latency_s)
        return ActionChunk(rows.astype(np.float32))

    def reset(self) -> None:
        """Start the motion anew from the joints of the next observation."""
        self._start = None

    def close(self) -> None:
        """Do nothing, because there is no connection."""

    def _begin(self, observation: Observation) -> None:
        """Choose for each joint the direction with more room to its limit, and start from the observed joints."""
        robot = self._robot
        self._start = np.clip(observation.qpos.astype(np.float64), robot.lower, robot.upper)
        self._first_step = observation.step
        reach = np.full(robot.dim, self._config.amplitude)
        grippers = list(robot.gripper_dims)
        reach[grippers] = 0.5 * (robot.upper - robot.lower)[grippers]
        reach[list(robot.binary_dims)] = 0.0
        up, down = robot.upper - self._start, self._start - robot.lower
        self._way = np.where(up >= down, np.minimum(reach, up), -np.minimum(reach, down))

    def _rows(self, steps: int) -> Float64:
        times = (steps + np.arange(self._config.horizon)) / self._control_rate
        out = 0.5 * (1.0 - np.cos(2.0 * np.pi * times / self._config.period_s))
        assert self._start is not None
        return np.asarray(self._start + out[:, None] * self._way)
