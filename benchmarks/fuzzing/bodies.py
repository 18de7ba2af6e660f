"""Robots as fuzzers take them: what their numbers can do, with all their groups, and joints that turn for ever."""

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

_WHOLE = ("left_arm", "right_arm", "torso", "base")  # of an R1 Lite: the one robot here that drives


class Body(NamedTuple):
    """Limits of a robot, numbers of it that do not blend, its binary grippers, and its ready pose [D]."""

    name: str
    limits: Limits
    dims: DimensionKinds
    switches: tuple[BinaryGripper, ...]
    ready: Float64


@cache
def body(name: str, groups: tuple[str, ...] | None = None) -> Body:
    """The robot `name` with these of its groups."""
    robot = robots.load_robot(name, groups and list(groups))
    spec = StationSpec.__new__(StationSpec)
    object.__setattr__(spec, "robot", robot)
    ready = robot.poses["ready"].astype(np.float64)
    return Body(name, spec.limits, spec.dims, binary_grippers_of(robot), ready)


def drawn(rng: np.random.Generator) -> Body:
    """One of the bundled robots, now and then with everything that it has, or with joints without limits."""
    name = str(rng.choice([*sorted(robots.robot_names()), "r1_lite"]))
    made = body(name, _WHOLE if name == "r1_lite" and rng.random() < 0.5 else None)
    return _endless(made, rng) if rng.random() < 0.3 else made


def _endless(made: Body, rng: np.random.Generator) -> Body:
    """The robot with two joints that have no limits, near half a turn, where a reading begins anew."""
    turning = np.sort(rng.choice(np.flatnonzero(made.limits.position_mask), 2, replace=False))
    lower, upper, ready = made.limits.lower.copy(), made.limits.upper.copy(), made.ready.copy()
    lower[turning], upper[turning] = -np.inf, np.inf
    ready[turning] = np.pi + rng.uniform(-0.2, 0.2, 2)
    limits = replace(made.limits, lower=lower, upper=upper)
    return made._replace(
        limits=limits, dims=DimensionKinds(made.dims.switched, tuple(turning.tolist())), ready=ready
    )
