"""Routes that pick and place a block with one arm: timed legs of joint targets.

A leg with a gate opens or closes the jaws, and the next leg begins only when they have moved. Between a few postures
the rows are interpolated in joint space with minimum-jerk timing (Flash and Hogan 1985), so that planning is cheap and
is done once per attempt.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.bench import Bench
from runtime.simulation.bench.hands import Opening
from runtime.simulation.scripts.clearance import clearance_for
from runtime.simulation.scripts.downward_tip import Place
from runtime.simulation.scripts.postures import (
    CLEAR,
    TILTS,
    Postures,
    closed,
    gripper_dim,
    jaws,
    opened,
)

if TYPE_CHECKING:
    from robots import Group, Robot

_SPEED = 0.75  # [rad/s] peak speed of the fastest joint
_TIP_SPEED = 0.11  # [m/s] peak speed on vertical paths
_SHORTEST = 0.5  # [s] duration of a leg
_JAW_SPEED = 0.16  # [m/s] of the jaws' opening
_PAUSE = 0.3  # [s] at rest at the start of a route, because its first rows arrive late
_DWELL = 0.2  # [s] by which a gate's rows continue after the jaws' motion
_PEAK = 1.875  # ratio of peak to mean speed of a minimum-jerk motion
_AT_REST = 0.02  # [rad] from the rest posture

Gate = Literal["", "close", "open"]


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """Part of a route: rows float64 [n, D], one per control period.

    `gate` is "close" or "open" if the leg moves the jaws; it then ends as soon as the measured jaws have moved. `gate`
    is "" for all other legs. `others` are the arms that this leg moves out of the way; it is empty if the leg moves the
    route's own arm.
    """

    name: str
    rows: Float64
    gate: Gate = ""
    others: tuple[Group, ...] = ()

    @property
    def end(self) -> Float64:
        """Last row of the leg [D]."""
        return np.asarray(self.rows[-1])


@dataclass(frozen=True, slots=True)
class PlannedFailure:
    """Deliberate failure of a route.

    `short` [m] is the distance by which the arm reaches too short, so that the jaws close before the block. If
    `lets_go`, the jaws release the block on the way to the plate.
    """

    short: float = 0.0
    lets_go: bool = False


@dataclass(frozen=True, eq=False)
class Route:
    """Motion of one arm in legs; the other arms do not move, or move out of the way first.

    `rows` [N, D] are the rows of all legs, `starts` the index of each leg's first row among them.
    """

    arm: Group
    legs: tuple[Leg, ...]

    @cached_property
    def rows(self) -> Float64:
        return np.concatenate([leg.rows for leg in self.legs])

    @cached_property
    def starts(self) -> tuple[int, ...]:
        return tuple(itertools.accumulate((len(leg.rows) for leg in self.legs[:-1]), initial=0))


class RoutePlanner:
    """Planner of routes for one robot at one bench, with `rate` rows per second."""

    def __init__(self, robot: Robot, rate: float, table: Bench) -> None:
        self._robot = robot
        self._rate = rate
        self._postures = Postures(robot, table)
        self._room = clearance_for(robot)
        self._speed = np.minimum(0.5 * robot.velocity, _SPEED)
        for arm in self._postures.arms:
            self._speed[gripper_dim(arm)] = min(0.5 * robot.velocity[gripper_dim(arm)], _jaw_speed(arm))

    def pick_and_place(
        self, q: Float64, block: tuple[float, float, float], plate: Place, slip: PlannedFailure
    ) -> Route | None:
        """Return the route from joints q [D] with the nearest arm that reaches all of it; None if no arm does.

        If the route comes too near to another arm or the body, another arm is tried, then routes for which other arms
        move out of the way. If none is clear, the route with the largest clearance is returned.
        """
        best, most = None, -math.inf
        for route in self._routes(q, block, plate, slip):
            spare = self._room.margin_along(route.rows)
            if spare >= 0:
                return route
            if spare > most:
                best, most = route, spare
        return best

    def _routes(
        self, q: Float64, block: tuple[float, float, float], plate: Place, slip: PlannedFailure
    ) -> Iterator[Route]:
        """Yield the possible routes for the block, the preferred ones first.

        First come the routes of all arms from the joints `q`, those of the arm nearest to the block before those of the
        others. After them come routes that begin by moving the other arms to rest, in the same order of the arms.
        """
        nearest = sorted(self._postures.arms, key=lambda arm: self._postures.distance(arm, block))
        for makes_way in (False, True):
            for arm in nearest:
                before = self._clear_other_arms(arm, q) if makes_way else []
                if makes_way and not before:
                    continue
                start = before[-1].end if before else q
                for tilts in TILTS:
                    down, over = self._postures.stations(arm, start, block, plate, slip.short, tilts)
                    if down is not None and over is not None:
                        yield self._begun(arm, [*before, *self._legs(arm, start, down, over, slip)])

    def _clear_other_arms(self, arm: Group, q: Float64) -> list[Leg]:
        """Return the legs that move all other arms to rest, first up from the table; [] if they are at rest already."""
        others_away = tuple(
            other_arm
            for other_arm in self._robot.arms
            if other_arm is not arm and np.abs(self._postures.stowed(other_arm, q) - q).max() > _AT_REST
        )
        if not others_away:
            return []
        high = q
        for other_arm in others_away:
            high = self._postures.risen(other_arm, high) if self._low(other_arm, high) else high
        stowed = high
        for other_arm in others_away:
            stowed = self._postures.stowed(other_arm, stowed)
        moves = [("rise", q, high)] * (high is not q) + [("make way", high, stowed)]
        return [replace(self._leg(*move), others=others_away) for move in moves]

    def _low(self, arm: Group, q: Float64) -> bool:
        """Return True if the fingertips are so near to the table that they have to rise before any other motion."""
        return bool(self._postures.tip(arm, q)[2, 3] < 0.75 * CLEAR)

    def retreat(self, q: Float64, arm: Group) -> Route:
        """Return the route that opens the jaws, raises the arm, and moves it to rest, out of the camera's view."""
        high = opened(arm, self._postures.risen(arm, q))
        return self._begun(
            arm, [self._leg("back off", q, high), self._leg("retreat", high, self._postures.rested(arm, q))]
        )

    def _legs(self, arm: Group, q: Float64, down: Float64, over: Float64, slip: PlannedFailure) -> list[Leg]:
        """Return the legs of a route from joints `q` [D].

        Args:
            arm: Arm that moves.
            q: Joints at the start of the route [D].
            down: Joints [stations, D] on the path down to the block, from the top, with open jaws.
            over: Joints [stations, D] on the path down to the plate, from the top, with open jaws.
            slip: Deliberate failure; if it lets go, the jaws open halfway to the plate.
        """
        gripped, lowered = (closed(arm, descent) for descent in (down, over))
        legs = []
        if self._low(arm, q):
            legs.append(self._leg("rise", q, self._postures.risen(arm, q)))
            q = legs[-1].end
        legs += [self._leg("reach", q, down[0]), self._vertical_leg("descend", down)]
        legs += [self._jaw_leg("close", down[-1], gripped[-1]), self._vertical_leg("lift", gripped[::-1])]
        carry = self._leg("carry", gripped[0], lowered[0])
        if slip.lets_go:
            half = carry.rows[: len(carry.rows) // 2]
            last = opened(arm, half[-1])
            legs += [Leg("carry", half), self._jaw_leg("open", half[-1], last)]
        else:
            last = over[0]
            legs += [carry, self._vertical_leg("lower", lowered)]
            legs += [self._jaw_leg("open", lowered[-1], over[-1]), self._vertical_leg("leave", over[::-1])]
        legs.append(self._leg("retreat", last, self._postures.rested(arm, q)))
        return legs

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
        """Return rows [n, D] of a motion through the joints `stations` [k, D], at rest at both ends.

        The path is a polynomial through the stations, with minimum-jerk timing. The motion lasts at least `shortest`
        [s].
        """
        marks = np.linspace(0.0, 1.0, len(stations))
        powers = np.linalg.solve(np.vander(marks, increasing=True), stations)
        joint_travel = np.abs(np.diff(stations, axis=0)).sum(axis=0)
        seconds = max(_SHORTEST, shortest, _PEAK * float((joint_travel / self._speed).max()))
        u = np.linspace(0.0, 1.0, 1 + math.ceil(seconds * self._rate))
        s = u**3 * (10 - 15 * u + 6 * u * u)
        rows = np.vander(s, len(stations), increasing=True) @ powers
        switched = list(
            self._robot.binary_dims
        )  # binary grippers have no values in between: a gradual motion would restart at each request
        rows[:, switched] = stations[-1, switched]
        return np.asarray(np.clip(rows, self._robot.lower, self._robot.upper))


def _jaw_speed(arm: Group) -> float:
    """Return the speed of an arm's jaws, in the unit of the gripper's joint per second."""
    opening = Opening(jaws(arm))
    return abs(opening.number(_JAW_SPEED) - opening.number(0.0))
