"""The fingers of a simulated arm: where they are, how far they are open, and what keeps them from closing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from runtime.sim.bench import BenchError, tip_in_world
from runtime.types import Float64

if TYPE_CHECKING:
    from robots import Group

FINGER_RADIUS = 0.01  # m; a finger is a row of balls whose inner sides are as far apart as the jaws are open
_ALONG = np.array([-0.01, -0.03, -0.05, -0.07])  # m from the tip, where these balls are
_UNMEASURED_JAWS = 0.1  # m between the fingers of an open gripper whose number is no length


@dataclass(frozen=True, slots=True, eq=False)
class Hand:
    """An arm's fingers at one instant: `tip` [4, 4] in the world (z ahead, y the way they open).

    `opening` [m] lies between them, `speed` [m/s] is the tip's over the table.
    """

    arm: str
    tip: Float64
    opening: float
    speed: float

    @property
    def tilt(self) -> float:
        """Radians between the way the fingers point and straight down."""
        return float(np.arccos(np.clip(-self.tip[2, 2], -1.0, 1.0)))

    def balls(self) -> Float64:
        """Centres [n, 3] of the balls that make up both fingers."""
        across = self.opening / 2 + FINGER_RADIUS
        inside = [(0.0, side * across, along) for side in (-1, 1) for along in _ALONG]
        return np.asarray(np.array(inside) @ self.tip[:3, :3].T + self.tip[:3, 3])


class Jaws:
    """Turns an arm's place in the robot's vector into a Hand, and holds its gripper up at a width."""

    def __init__(self, arm: Group) -> None:
        if arm.gripper is None or arm.gripper_dim is None:
            raise BenchError(f"group {arm.name} has no gripper; allowed: an arm")
        self.name = arm.name
        self._arm = arm
        self._dim = arm.gripper_dim
        self._close, self._way = arm.gripper.close, arm.gripper.open - arm.gripper.close
        self._widest = abs(self._way) if arm.gripper.unit == "m" else _UNMEASURED_JAWS

    def hand(self, q: Float64, before: Hand | None, seconds: float) -> Hand:
        """The fingers at joints q [D]; `before` is where they were `seconds` ago."""
        tip = tip_in_world(self._arm, q)
        way = 0.0 if before is None else float(np.linalg.norm(tip[:2, 3] - before.tip[:2, 3]))
        opening = max(0.0, float((q[self._dim] - self._close) / self._way * self._widest))
        return Hand(self.name, tip, opening, way / seconds if seconds > 0 else 0.0)

    def stop(self, q: Float64, opening: float) -> None:
        """Write into q [D] that the jaws are `opening` [m] apart."""
        q[self._dim] = self._close + opening / self._widest * self._way
