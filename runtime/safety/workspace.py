"""The boxes that end effectors must stay in."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robots import Robot
from runtime.core.types import Float64
from runtime.safety.filter import WorkspaceBox


class Workspace:
    """Which arms' end effectors are outside their boxes, by the robot's own forward kinematics.

    `arms` are those that have a box, in the robot's order.
    """

    def __init__(self, robot: Robot, boxes: Mapping[str, WorkspaceBox]) -> None:
        self._groups = [arm for arm in robot.arms if arm.name in boxes]
        self.arms = tuple(arm.name for arm in self._groups)
        self._lower = np.array([boxes[name].lower for name in self.arms]).reshape(-1, 3)
        self._upper = np.array([boxes[name].upper for name in self.arms]).reshape(-1, 3)

    def __call__(self, q: Float64) -> tuple[str, ...]:
        """The names of the arms that are outside with any of the joints q [..., D]."""
        outside = self.is_outside(q)
        return tuple(name for index, name in enumerate(self.arms) if outside[..., index].any())

    def is_outside(self, q: Float64) -> NDArray[np.bool_]:
        """True for each of `arms` that is outside, bool [..., arms], with the joints q [..., D]."""
        return np.asarray(self.excess(q) > 0.0)

    def excess(self, q: Float64) -> Float64:
        """Distance of each of `arms` outside [..., arms], on the worst axis [m], with joints q [..., D]."""
        if not self._groups:
            return np.zeros((*q.shape[:-1], 0))
        points = np.stack([arm.transform(q)[..., :3, 3] for arm in self._groups], axis=-2)
        beyond: Float64 = np.maximum(self._lower - points, points - self._upper).max(axis=-1)
        return np.maximum(beyond, 0.0)

    def arm_leaving_on(self, way: Float64) -> str:
        """The arm that leaves its box somewhere on a `way` [T, D] in joints; "" where none does.

        Who begins outside may go anywhere until it is inside.
        """
        outside = self.is_outside(way)
        left = (~outside[:-1] & outside[1:]).any(axis=0)
        return self.arms[int(left.argmax())] if left.any() else ""
