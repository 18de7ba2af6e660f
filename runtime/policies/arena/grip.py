"""Grippers as DROID counts them, 0 open and 1 closed, from and to a robot's own numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from runtime.types import Float32, Float64

if TYPE_CHECKING:
    from robots import Robot

Convention = Literal["droid", "robot"]


class Grip:
    """The numbers of all grippers of a robot, [..., G]; "robot" leaves them as they are."""

    def __init__(self, convention: Convention, robot: Robot) -> None:
        grippers = [group.gripper for group in robot.groups if group.gripper is not None]
        self._converts = convention == "droid"
        self._open = np.array([gripper.open for gripper in grippers], np.float64)
        self._travel = np.array([gripper.close - gripper.open for gripper in grippers], np.float64)

    def shown(self, numbers: Float64) -> Float64:
        """As the policy is shown them; a gripper a little beyond its ends is at them."""
        if not self._converts:
            return numbers
        return np.clip((numbers - self._open) / self._travel, 0.0, 1.0)

    def meant(self, numbers: Float32) -> Float32:
        """What the policy's numbers are on the robot; beyond 0 and 1 there is nothing to close or open."""
        if not self._converts:
            return numbers
        return (self._open + np.clip(numbers, 0.0, 1.0) * self._travel).astype(np.float32)
