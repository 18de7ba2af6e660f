"""Robots for fuzzers, described by the limits of their numbers.

Some are drawn with all of their groups, some with joints that have no limits.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

import robots
from runtime.core.types import Float64
from runtime.motion.timeline import DimensionKinds
from runtime.safety.limits import Limits
from runtime.spaces.binary_grippers import BinaryGripper, binary_grippers_of
from runtime.station.spec import StationSpec

_WHOLE = (
    "left_arm",
    "right_arm",
    "torso",
    "base",
)  # groups of an R1 Lite, the only bundled robot with a mobile base


class Body(NamedTuple):
    """Limits of a robot, its dimensions that do not blend linearly, its binary grippers, and its ready pose [D]."""

    name: str
    limits: Limits
    dims: DimensionKinds
    switches: tuple[BinaryGripper, ...]
    ready: Float64


@cache
def body(name: str, groups: tuple[str, ...] | None = None) -> Body:
    """Return the robot `name` with these groups."""
    robot = robots.load_robot(name, groups and list(groups))
    spec = StationSpec.__new__(StationSpec)
    object.__setattr__(spec, "robot", robot)
    ready = robot.poses["ready"].astype(np.float64)
    return Body(name, spec.limits, spec.dims, binary_grippers_of(robot), ready)


def drawn(rng: np.random.Generator) -> Body:
    """Return a random bundled robot, sometimes with all groups, or with joints without limits."""
    name = str(rng.choice([*sorted(robots.robot_names()), "r1_lite"]))
    sampled = body(name, _WHOLE if name == "r1_lite" and rng.random() < 0.5 else None)
    return _endless(sampled, rng) if rng.random() < 0.3 else sampled


def _endless(bounded: Body, rng: np.random.Generator) -> Body:
    """Return the robot with two joints without limits whose ready pose is near half a turn, where readings wrap."""
    turning = np.sort(rng.choice(np.flatnonzero(bounded.limits.position_mask), 2, replace=False))
    lower, upper, ready = bounded.limits.lower.copy(), bounded.limits.upper.copy(), bounded.ready.copy()
    lower[turning], upper[turning] = -np.inf, np.inf
    ready[turning] = np.pi + rng.uniform(-0.2, 0.2, 2)
    limits = replace(bounded.limits, lower=lower, upper=upper)
    return bounded._replace(
        limits=limits, dims=DimensionKinds(bounded.dims.switched, tuple(turning.tolist())), ready=ready
    )
