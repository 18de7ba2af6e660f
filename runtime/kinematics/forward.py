"""Forward kinematics in numpy, for processes that never solve and so need no compiler."""

from __future__ import annotations

import numpy as np

from robots import Robot
from runtime.core.types import Float64
from runtime.kinematics.base import Forward, KinematicsError


class ChainForward(Forward):
    """Forward kinematics by the robot's own chains: tens of microseconds per vector, nothing to compile."""

    def __init__(self, robot: Robot) -> None:
        self._arms = robot.arms
        self._dim = robot.dim

    def forward(self, q: Float64) -> Float64:
        """Return poses [..., arms, 7] of joint vectors [..., D].

        Raises:
            KinematicsError: another width.
        """
        q = np.asarray(q, dtype=np.float64)
        if q.shape[-1:] != (self._dim,):
            raise KinematicsError(f"joints of shape {q.shape} were given; allowed: [..., {self._dim}]")
        poses = np.empty((*q.shape[:-1], len(self._arms), 7))
        for index, arm in enumerate(self._arms):
            poses[..., index, :] = arm.pose(q)
        return poses
