"""The fingers of a simulated arm: where they are, how far they are open, and what keeps them from closing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.bench import BenchError

if TYPE_CHECKING:
    from robots import Gripper, Group, Robot

FINGER_RADIUS = 0.01  # m; a finger is a row of balls whose inner sides are as far apart as the jaws are open
_ALONG = np.array([-0.01, -0.03, -0.05, -0.07])  # m from the tip, where these balls are
_UNMEASURED_JAWS = 0.1  # m


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

    def __init__(self, robot: Robot, arm: Group) -> None:
        if arm.gripper is None or arm.gripper_dim is None:
            raise BenchError(f"group {arm.name} has no gripper; allowed: an arm with one")
        self.name = arm.name
        self._limb = arm_frames(robot)[arm.name]
        self._dim = arm.gripper_dim
        self._opening = Opening(arm.gripper)

    def hand(self, q: Float64, before: Hand | None, seconds: float) -> Hand:
        """The fingers at joints q [D]; `before` is where they were `seconds` ago."""
        tip = self._limb.tip(q)
        way = 0.0 if before is None else float(np.linalg.norm(tip[:2, 3] - before.tip[:2, 3]))
        opening = max(0.0, self._opening.metres(float(q[self._dim])))
        return Hand(self.name, tip, opening, way / seconds if seconds > 0 else 0.0)

    def stop(self, q: Float64, opening: float) -> None:
        """Write into q [D] that the jaws are `opening` [m] apart."""
        q[self._dim] = self._opening.number(opening)


class Opening:
    """Distance between the fingers of a gripper [m], and its number on the wire, in proportion.

    Where a description does not say it, they are taken to be 0.1 m apart when open.
    """

    def __init__(self, gripper: Gripper) -> None:
        self._close, self._way = gripper.close, gripper.open - gripper.close
        self._least, most = gripper.apart or (0.0, _UNMEASURED_JAWS)
        self._most = most - self._least

    def metres(self, number: float) -> float:
        """Between the fingers at a number of the wire."""
        return self._least + (number - self._close) / self._way * self._most

    def number(self, metres: float) -> float:
        """Of the wire, at which the fingers are so far apart."""
        return self._close + (metres - self._least) / self._most * self._way
