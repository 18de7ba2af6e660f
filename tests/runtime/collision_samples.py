"""Postures of the two Pipers that are about to meet."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np

import robots
from robots import Robot
from runtime.core.types import Float64
from runtime.safety.collision import Collisions

MARGIN = 0.005
GRIPPERS = [6, 13]


@cache
def robot() -> Robot:
    return robots.load_robot("agilex_piper")


@cache
def collisions(margin: float = MARGIN) -> Collisions:
    return Collisions(robot(), margin)


def turned(inwards: float, opening: float = 0.1) -> Float64:
    """Both arms as in `ready`, turned towards each other: they touch from about 1 rad on, most at 1.6."""
    q = robot().poses["ready"].copy()
    q[0], q[7] = -inwards, inwards
    q[GRIPPERS] = opening
    return q


def way(*postures: Float64, count: int = 200) -> Float64:
    """Straight lines [T, D] from posture to posture."""
    legs = [a + np.linspace(0, 1, count)[:, None] * (b - a) for a, b in pairwise(postures)]
    return np.concatenate(legs)
