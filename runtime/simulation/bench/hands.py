"""Fingers of a simulated arm: their pose, their opening, and the limit that a held block sets to the opening."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.bench import BenchError

if TYPE_CHECKING:
    from robots import Gripper, Group, Robot

FINGER_RADIUS = 0.01  # [m]; fingers are rows of balls, with inner sides as far apart as the jaws
_ALONG = np.array([-0.01, -0.03, -0.05, -0.07])  # [m] places of these balls ahead of the fingertips
_UNMEASURED_JAWS = 0.1  # [m] opening of grippers that do not declare it


@dataclass(frozen=True, slots=True, eq=False)
class Hand:
    """Fingers of an arm at one moment.

    `tip` [4, 4] is the pose of the fingertips in the world: z ahead, y the direction in which the fingers open.
    `opening` [m] is the distance between the fingers. `speed` [m/s] is the speed at which the fingertips move over the
    table.
    """

    arm: str
    tip: Float64
    opening: float
    speed: float

    @property
    def tilt(self) -> float:
        """Angle between the fingers' direction and straight down [rad]."""
        return float(np.arccos(np.clip(-self.tip[2, 2], -1.0, 1.0)))

    def balls(self) -> Float64:
        """Return the centres [n, 3] of the balls that model both fingers."""
        across = self.opening / 2 + FINGER_RADIUS
        inside = [(0.0, side * across, along) for side in (-1, 1) for along in _ALONG]
        return np.asarray(np.array(inside) @ self.tip[:3, :3].T + self.tip[:3, 3])


class Jaws:
    """Gripper of an arm: converts the robot's joints to a `Hand`, and stops the gripper at a width.

    Raises:
        BenchError: If the group has no gripper.
    """

    def __init__(self, robot: Robot, arm: Group) -> None:
        if arm.gripper is None or arm.gripper_dim is None:
            raise BenchError(f"group {arm.name} has no gripper; allowed: an arm with one")
        self.name = arm.name
        self._limb = arm_frames(robot)[arm.name]
        self._dim = arm.gripper_dim
        self._opening = Opening(arm.gripper)

    def hand(self, q: Float64, before: Hand | None, seconds: float) -> Hand:
        """Return the fingers at joints q [D]; `before` is their state `seconds` ago, None at the first step."""
        tip = self._limb.tip(q)
        travel = 0.0 if before is None else float(np.linalg.norm(tip[:2, 3] - before.tip[:2, 3]))
        opening = max(0.0, self._opening.metres(float(q[self._dim])))
        return Hand(self.name, tip, opening, travel / seconds if seconds > 0 else 0.0)

    def stop(self, q: Float64, opening: float) -> None:
        """Stop the gripper where the jaws are `opening` [m] apart: set the gripper's value in `q` [D] in place."""
        q[self._dim] = self._opening.number(opening)


class Opening:
    """Linear conversion between a gripper's joint value and the distance between its fingers [m].

    If the description does not declare the distances of the closed and the open gripper, they are taken as 0 and 0.1 m.
    """

    def __init__(self, gripper: Gripper) -> None:
        self._close, self._way = gripper.close, gripper.open - gripper.close
        self._least, most = gripper.apart or (0.0, _UNMEASURED_JAWS)
        self._most = most - self._least

    def metres(self, number: float) -> float:
        """Return the distance between the fingers [m] at the joint value `number`."""
        return self._least + (number - self._close) / self._way * self._most

    def number(self, metres: float) -> float:
        """Return the joint value at which the fingers are `metres` apart."""
        return self._close + (metres - self._least) / self._most * self._way
