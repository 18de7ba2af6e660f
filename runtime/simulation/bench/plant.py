"""Kinematic robot model: every joint follows its target with a lag, within its velocity limit."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import EEF_WIDTH, Float32, Float64

if TYPE_CHECKING:
    from robots import Group, Robot

LAG = 0.06  # [s] time constant of each joint


class Plant:
    """Joints `q` float64 [D] of a robot; they start at home, or at `start`, and move towards `target` [D].

    On a bench with contact forces, `reference` [D] is the position at which the drives aim; forces keep `q` slightly
    away from it. It is None if the joints are exactly where the drives aim. `row` [D] is the newest row of a policy or
    leader until a bench that advances by rows has executed it.
    """

    def __init__(self, robot: Robot, lag: float = LAG, start: Float64 | None = None) -> None:
        self._robot = robot
        self._lag = lag
        self.q: Float64 = (robot.poses["home"] if start is None else start).copy()
        self.target: Float64 = self.q.copy()
        self.reference: Float64 | None = None
        self.row: Float64 | None = None

    def advance(self, seconds: float) -> None:
        """Advance by `seconds`: the joints approach the target with a first-order lag, within their velocity limits."""
        wish = (self.target - self.q) * -math.expm1(-seconds / self._lag)
        reach = self._robot.velocity * seconds
        self.q = self.q + np.clip(wish, -reach, reach)

    def hold(self) -> None:
        """Set the target to the present joints, so that the robot stops; jaws keep the force with which they grip."""
        self.target = (self.q if self.reference is None else self.reference).copy()


def poses(robot: Robot, q: Float64) -> dict[str, Float32]:
    """Return the end-effector vector float32 [8] of each arm at joints [D]: pose and gripper, 0 without a gripper."""
    return {arm.name: _pose(arm, q) for arm in robot.arms}


def _pose(arm: Group, q: Float64) -> Float32:
    vector = np.zeros(EEF_WIDTH, np.float32)
    vector[:7] = arm.pose(q)
    if arm.gripper_dim is not None:
        vector[7] = q[arm.gripper_dim]
    return vector
