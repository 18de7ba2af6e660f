"""Workspace boxes that end effectors must not leave."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robots import Robot
from runtime.core.types import Float64
from runtime.safety.filter import WorkspaceBox


class Workspace:
    """Check of arms against their workspace boxes, by the robot's forward kinematics.

    `arms` are the names of the arms that have a box, in the robot's order.
    """

    def __init__(self, robot: Robot, boxes: Mapping[str, WorkspaceBox]) -> None:
        self._groups = [arm for arm in robot.arms if arm.name in boxes]
        self.arms = tuple(arm.name for arm in self._groups)
        self._lower = np.array([boxes[name].lower for name in self.arms]).reshape(-1, 3)
        self._upper = np.array([boxes[name].upper for name in self.arms]).reshape(-1, 3)

    def __call__(self, q: Float64) -> tuple[str, ...]:
        """Return the names of the arms that are outside their box for any of the joint vectors q [..., D]."""
        outside = self.is_outside(q)
        return tuple(name for index, name in enumerate(self.arms) if outside[..., index].any())

    def is_outside(self, q: Float64) -> NDArray[np.bool_]:
        """Return bool [..., arms] for joints q [..., D]: which of `arms` are outside their box."""
        return np.asarray(self.excess(q) > 0.0)

    def excess(self, q: Float64) -> Float64:
        """Return how far each arm is outside its box on the worst axis [m], [..., arms]; 0 inside."""
        if not self._groups:
            return np.zeros((*q.shape[:-1], 0))
        points = np.stack([arm.transform(q)[..., :3, 3] for arm in self._groups], axis=-2)
        beyond: Float64 = np.maximum(self._lower - points, points - self._upper).max(axis=-1)
        return np.maximum(beyond, 0.0)

    def arm_leaving_on(self, way: Float64) -> str:
        """Return the name of an arm that leaves its box along `way` [T, D] (joints), "" if none does.

        An arm that starts outside is not restricted until it is inside.
        """
        outside = self.is_outside(way)
        left = (~outside[:-1] & outside[1:]).any(axis=0)
        return self.arms[int(left.argmax())] if left.any() else ""
