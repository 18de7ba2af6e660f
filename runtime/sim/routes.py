"""How an arm picks a block up and puts it down: legs of joint targets, timed, with gates for the jaws between.

Between few postures the rows are interpolated in joint space with minimum-jerk timing (Flash and Hogan 1985), so
that an attempt is planned once and cheaply.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from runtime.sim.bench import Bench
from runtime.sim.down import Place
from runtime.sim.hands import Opening
from runtime.sim.postures import CLEAR, TILTS, Postures, closed, gripper_dim, jaws, opened
from runtime.types import Float64

if TYPE_CHECKING:
    from robots import Group, Robot

_SPEED = 0.75  # rad/s of the fastest joint, at its fastest
_TIP_SPEED = 0.11  # m/s on vertical ways, at its fastest
_SHORTEST = 0.5  # s
_JAW_SPEED = 0.16  # m/s
_PAUSE = 0.3  # s that a route stands still at first: its rows arrive late
_DWELL = 0.2  # s by which a gate outlasts the way of its jaws
_PEAK = 1.875  # highest over mean speed of a minimum-jerk motion

Gate = Literal["", "close", "open"]


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """Rows float64 [n, D], one per control period; a gate's leg ends when the jaws are seen to have obeyed."""

    name: str
    rows: Float64
    gate: Gate = ""

    @property
    def end(self) -> Float64:
        """Its last row [D]."""
        return np.asarray(self.rows[-1])


@dataclass(frozen=True, slots=True)
class Slip:
    """What goes wrong on purpose: the jaws close `short` of the block [m], or let it go on the way."""

    short: float = 0.0
    lets_go: bool = False


@dataclass(frozen=True, eq=False)
class Route:
    """What one arm does, leg after leg; the rest of the robot stays.

    `rows` [N, D] are those of all legs, `starts` the places of each leg's first one among them.
    """

    arm: Group
    legs: tuple[Leg, ...]

    @cached_property
    def rows(self) -> Float64:
        return np.concatenate([leg.rows for leg in self.legs])

    @cached_property
    def starts(self) -> tuple[int, ...]:
        return tuple(itertools.accumulate((len(leg.rows) for leg in self.legs[:-1]), initial=0))


class Planner:
    """Plans for one robot at one bench, `rate` rows per second."""

    def __init__(self, robot: Robot, rate: float, table: Bench) -> None:
        self._robot = robot
        self._rate = rate
        self._postures = Postures(robot, table)
        self._speed = np.minimum(0.5 * robot.velocity, _SPEED)
        for arm in self._postures.arms:
            self._speed[gripper_dim(arm)] = min(0.5 * robot.velocity[gripper_dim(arm)], _jaw_speed(arm))

    def pick_and_place(
        self, q: Float64, block: tuple[float, float, float], plate: Place, slip: Slip
    ) -> Route | None:
        """The route from joints q [D], by the arm nearest the block that reaches all of it; None if none does."""
        for arm in sorted(self._postures.arms, key=lambda arm: self._postures.distance(arm, block)):
            for tilts in TILTS:
                down, over = self._postures.stations(arm, q, block, plate, slip.short, tilts)
                if down is not None and over is not None:
                    return self._route(arm, q, down, over, slip)
        return None

    def retreat(self, q: Float64, arm: Group) -> Route:
        """Open the jaws, rise, and go where the arm is out of the camera's way."""
        high = opened(arm, self._postures.risen(arm, q))
        return self._begun(
            arm, [self._leg("back off", q, high), self._leg("retreat", high, self._postures.rested(arm, q))]
        )

    def _route(self, arm: Group, q: Float64, down: Float64, over: Float64, slip: Slip) -> Route:
        """From the stations above to below the block, `down`, and the plate, `over`, [stations, D], jaws open."""
        held, lowered = (closed(arm, way) for way in (down, over))
        legs = []
        if self._postures.tip(arm, q)[2, 3] < 0.75 * CLEAR:
            legs.append(self._leg("rise", q, self._postures.risen(arm, q)))
            q = legs[-1].end
        legs += [self._leg("reach", q, down[0]), self._vertical_leg("descend", down)]
        legs += [self._jaw_leg("close", down[-1], held[-1]), self._vertical_leg("lift", held[::-1])]
        carry = self._leg("carry", held[0], lowered[0])
        if slip.lets_go:
            half = carry.rows[: len(carry.rows) // 2]
            last = opened(arm, half[-1])
            legs += [Leg("carry", half), self._jaw_leg("open", half[-1], last)]
        else:
            last = over[0]
            legs += [carry, self._vertical_leg("lower", lowered)]
            legs += [self._jaw_leg("open", lowered[-1], over[-1]), self._vertical_leg("leave", over[::-1])]
        legs.append(self._leg("retreat", last, self._postures.rested(arm, q)))
        return self._begun(arm, legs)

    def _begun(self, arm: Group, legs: Sequence[Leg]) -> Route:
        first = legs[0]
        still = np.repeat(first.rows[:1], round(_PAUSE * self._rate), axis=0)
        return Route(arm, (replace(first, rows=np.concatenate([still, first.rows])), *legs[1:]))

    def _leg(self, name: str, start: Float64, end: Float64) -> Leg:
        return Leg(name, self._timed(np.stack([start, end]), 0.0))

    def _vertical_leg(self, name: str, stations: Float64) -> Leg:
        return Leg(name, self._timed(stations, _PEAK * CLEAR / _TIP_SPEED))

    def _jaw_leg(self, gate: Literal["close", "open"], start: Float64, end: Float64) -> Leg:
        rows = self._timed(np.stack([start, end]), 0.0)
        return Leg(
            gate, np.concatenate([rows, np.repeat(rows[-1:], round(_DWELL * self._rate), axis=0)]), gate
        )

    def _timed(self, stations: Float64, shortest: float) -> Float64:
        """Rows [n, D] through stations [k, D], at rest at both ends: a polynomial, run with minimum jerk."""
        marks = np.linspace(0.0, 1.0, len(stations))
        powers = np.linalg.solve(np.vander(marks, increasing=True), stations)
        way = np.abs(np.diff(stations, axis=0)).sum(axis=0)
        seconds = max(_SHORTEST, shortest, _PEAK * float((way / self._speed).max()))
        u = np.linspace(0.0, 1.0, 1 + math.ceil(seconds * self._rate))
        s = u**3 * (10 - 15 * u + 6 * u * u)
        rows = np.vander(s, len(stations), increasing=True) @ powers
        return np.asarray(np.clip(rows, self._robot.lower, self._robot.upper))


def _jaw_speed(arm: Group) -> float:
    """In the gripper's own unit per second."""
    opening = Opening(jaws(arm))
    return abs(opening.number(_JAW_SPEED) - opening.number(0.0))
