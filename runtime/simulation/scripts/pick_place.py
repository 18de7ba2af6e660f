"""Scripted policy that picks up the block and puts it on the plate, using only its observations.

The policy detects block and plate in the overhead image of the request. It finds out from the joints in the request how
far it has come. Between the requests of one connection it remembers its route, its row in the route and the time. A
route consists of legs. A leg that moves the arm ends when the joints have arrived, a leg that opens or closes the jaws
when the measured jaws have moved. The row advances with the time between requests, so that a chunk continues the
previous chunk whatever the delay.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RuntimeFault
from runtime.core.types import Float32, Float64, UInt8
from runtime.simulation.bench.bench import Bench
from runtime.simulation.bench.hands import Opening
from runtime.simulation.scripts.detection import Detection, OverheadDetector
from runtime.simulation.scripts.postures import gripper_dim, jaws
from runtime.simulation.scripts.routes import PlannedFailure, Route, RoutePlanner
from runtime.simulation.scripts.script import Answer, Script

if TYPE_CHECKING:
    from robots import Group, Robot

_LEAD = 0.12  # [s] lag of robots: rows are ahead of the joints by it if the clock is not used
_BEHIND, _AHEAD = 0.8, 0.6  # [s] deviation of the clock's row from the joints' row; beyond it these decide
_FAR = 0.2  # [rad] distance of the joints from the clock's row; beyond it the joints decide
_THERE = 0.015  # [rad] distance from the end of a leg at which it is finished
_LOST = 0.35  # [rad] distance from a leg: something else has moved the robot
_MOVED = 0.025  # [m] displacement of block or plate that makes it a new scene
_MARGIN = 0.01  # [m] least distance of the block's middle inside the plate's rim
_GRIPPED = 1.25  # of the block's edge: narrower jaws have closed, on the block or on nothing
_EMPTY = 0.75  # of the block's edge: narrower jaws hold nothing
_SHORT = 0.05  # [m] by which a deliberately failing grasp is short
_CARRYING = ("lift", "carry", "lower")
_LEAVING = ("back off", "retreat")
_COMING = ("make way", "reach")
_ARM = 0.25  # [m] lever arm that converts shifts to radians
_PAUSED = 3.0  # [s] without a request after which a robot that was leaving begins a new episode


Apart = Callable[["Group", Float64, Float64], Float64]
"""Function of the moving arm, rows float64 [n, D] and joints [D]: distance of the joints from each row [n, rad]."""


class ScriptError(RuntimeFault):
    """Error that a script cannot answer a request."""


@dataclass(frozen=True, slots=True)
class Skill:
    """Deliberate imperfection of the policy.

    `noise` [m] is the standard deviation of the error of the block's place in x and in y, drawn for each attempt. The
    yaw has an error as well, whose standard deviation grows with `noise`: it is one radian if `noise` is the edge of a
    block.

    `failure_rate` is the probability that an episode fails. In an episode that fails, the policy either drops the block
    on the way or always grasps short of it. `seed` decides the errors and the failures, episode by episode.
    """

    noise: float = 0.0
    failure_rate: float = 0.0
    seed: int = 0


class PickPlace(Script):
    """Pick-and-place policy for all connections.

    Episodes are numbered over all connections, so that each has its own noise. `apart` is the function that computes
    how far the robot's joints are from each row of a route; by default it is the largest difference of a joint.
    """

    def __init__(
        self,
        robot: Robot,
        horizon: int,
        rate: float,
        skill: Skill,
        name: str | None = None,
        clock: Clock | None = None,
        apart: Apart | None = None,
        table: Bench | None = None,
    ) -> None:
        self.robot, self.clock = robot, clock or MonotonicClock()
        self.apart = apart or joints_apart(robot)
        self.horizon, self.rate, self.skill = horizon, rate, skill
        self.table = table or Bench()
        self.overhead = OverheadDetector(robot, self.table)
        self.planner = RoutePlanner(robot, rate, self.table)
        self._episodes = itertools.count()
        self.metadata = {
            "name": name or "pick-and-place",
            "description": "scripted pick-and-place: sees the overhead picture, not a learned policy",
            "action_horizon": horizon,
            "noise_mm": 1e3 * skill.noise,
            "failure_rate": skill.failure_rate,
            "seed": skill.seed,
        }

    def begin(self) -> Answer:
        """Return the function that answers the requests of a new connection."""
        return PickPlaceEpisode(self)

    def next_episode_noise(self) -> EpisodeNoise:
        """Return the noise of the next episode."""
        return EpisodeNoise(self.skill, next(self._episodes), self.table.block_edge)


class EpisodeNoise:
    """Random errors of one episode, which depend only on the seed and the episode's number."""

    def __init__(self, skill: Skill, episode: int, edge: float) -> None:
        self._chance = np.random.default_rng([skill.seed, episode])
        self._noise = skill.noise * np.array([1.0, 1.0, 1.0 / edge])
        fails, lets_go = self._chance.random(2)
        slips = fails < skill.failure_rate
        self.slip = PlannedFailure(_SHORT * (slips and lets_go >= 0.5), bool(slips and lets_go < 0.5))

    def perceive(self, block: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the block's place and yaw with the error of one attempt added."""
        x, y, yaw = np.array(block) + self._chance.normal(0.0, self._noise)
        return float(x), float(y), float(yaw)


class PickPlaceEpisode:
    """State of one connection: no route, or a route and the robot's progress on it."""

    def __init__(self, policy: PickPlace) -> None:
        self._policy = policy
        self._prompt = ""
        self._luck: EpisodeNoise | None = None
        self._resigned = False  # the episode failed deliberately, and is not tried again
        self._left: Detection | None = None  # detection after it resigned; a change begins a new episode
        self._route: Route | None = None
        self._seen = Detection()  # detection with which the route was planned
        self._leg = 0
        self._row = 0.0  # row in the whole route at the last request
        self._asked = 0.0  # [s] time of the last request

    def __call__(self, q: Float64, pictures: Mapping[str, UInt8], prompt: str) -> Float32:
        """Return rows float32 [H, D]: the next rows of the route, or the joints `q` if there is nothing to do."""
        detection = self._detect(pictures)
        now = self._policy.clock.now()
        elapsed, self._asked = now - self._asked, now
        if prompt != self._prompt or self._is_over(elapsed) or self._elsewhere(q, detection):
            self._forget()
        self._prompt = prompt
        if detection.dark:
            return self._still(q)
        self._advance(q, elapsed)
        if self._misses(q):
            self._follow_route(self._policy.planner.retreat(q, self._on().arm))
        if self._route is None:
            self._decide(q, detection)
        return self._still(q) if self._route is None else self._ahead(self._route)

    def _detect(self, pictures: Mapping[str, UInt8]) -> Detection:
        return self._policy.overhead.detect(self._picture(pictures))

    def _picture(self, pictures: Mapping[str, UInt8]) -> UInt8:
        """Return the overhead image of a request."""
        key = self._policy.overhead.key
        if key not in pictures:
            raise ScriptError(f"the request has no picture {key!r}; it has {', '.join(pictures) or 'none'}")
        return pictures[key]

    # --- deciding ------------------------------------------------------------------------------------------

    def _decide(self, q: Float64, detection: Detection) -> None:
        """Plan a route if block and plate are detected and the block is not on the plate yet."""
        if detection.block is None or detection.plate is None:
            return
        if self._is_done(detection.block, detection.plate):
            self._forget()
            return
        if self._resigned:
            self._left = self._left or detection
            if not _differs(detection, self._left):
                return
            self._forget()
        if self._luck is None:
            self._luck = self._policy.next_episode_noise()
        block = self._luck.perceive(detection.block)
        route = self._policy.planner.pick_and_place(q, block, detection.plate, self._luck.slip)
        if route is not None:
            self._seen = detection
            self._follow_route(route)

    def _is_done(self, block: tuple[float, float, float], plate: tuple[float, float]) -> bool:
        """Return True if the block is on the plate already."""
        return math.dist(block[:2], plate) < self._policy.table.discs[0].radius - _MARGIN

    def _follow_route(self, route: Route | None) -> None:
        self._route, self._leg, self._row = route, 0, 0.0

    def _forget(self) -> None:
        self._luck = self._left = None
        self._resigned = False
        self._follow_route(None)

    def _is_over(self, pause: float) -> bool:
        """Return True if the episode ended before a pause of `pause` [s] in the requests.

        The episode has ended if the pause is long and one of two conditions held before the pause: there was no route,
        or the arm was already leaving the plate.
        """
        leaving = self._route is None or self._route.legs[self._leg].name in _LEAVING
        return leaving and pause > _PAUSED

    def _elsewhere(self, q: Float64, detection: Detection) -> bool:
        """Return True if the robot is far from its route, or objects were moved before they were grasped."""
        if self._route is None:
            return False
        return self._distances(q).min() > _LOST or (
            self._route.legs[self._leg].name in _COMING and _differs(detection, self._seen)
        )

    # --- following -----------------------------------------------------------------------------------------

    def _on(self) -> Route:
        assert self._route is not None
        return self._route

    def _distances(self, q: Float64) -> Float64:
        """Return the distance [rad] of the joints `q` [D] from each row of the present leg of the route."""
        return self._apart(self._on().legs[self._leg].rows, q)

    def _apart(self, rows: Float64, q: Float64) -> Float64:
        route = self._on()
        movers = route.legs[self._leg].others or (route.arm,)
        return np.asarray(np.max([self._policy.apart(arm, rows, q) for arm in movers], axis=0))

    def _advance(self, q: Float64, elapsed: float) -> None:
        """Update leg and row from the time that has passed and the joints; a finished route is dropped."""
        row = self._row + elapsed * self._policy.rate
        while self._route is not None and self._passed(q):
            left, self._leg = self._route.legs[self._leg], self._leg + 1
            if left.gate:
                row = max(row, float(self._route.starts[self._leg]))
            if self._leg == len(self._route.legs):
                self._resigned = self._luck is not None and self._luck.slip.lets_go
                self._follow_route(None)
        if self._route is not None:
            self._row = self._agreed(row, q)

    def _agreed(self, row: float, q: Float64) -> float:
        """Return the row at which to continue: `row`, which follows from the time, if the joints `q` agree with it.

        If the joints show that the robot was delayed or moved, return a row slightly ahead of the one nearest to the
        joints.
        """
        route, rate = self._on(), self._policy.rate
        leg, start = route.legs[self._leg], route.starts[self._leg]
        jaw = gripper_dim(route.arm)
        away = np.abs(leg.rows[:, jaw] - q[jaw]) if leg.gate else self._distances(q)
        nearest = start + int(away.argmin())
        near = self._apart(route.rows[[min(round(row), len(route.rows) - 1)]], q)[0] <= _FAR
        if not (near and nearest - _BEHIND * rate <= row <= nearest + _AHEAD * rate):
            row = nearest + _LEAD * rate
        return min(row, start + len(leg.rows) - 1.0) if leg.gate else row

    def _passed(self, q: Float64) -> bool:
        leg, opening = self._on().legs[self._leg], self._opening(q)
        edge = self._policy.table.block_edge
        if leg.gate == "close":
            return opening < _GRIPPED * edge
        if leg.gate == "open":
            return opening > _GRIPPED * edge
        return bool(self._distances(q)[-1] < _THERE)

    def _misses(self, q: Float64) -> bool:
        """Return True if the jaws are empty on a leg on which they should hold the block."""
        if self._route is None or self._route.legs[self._leg].name not in _CARRYING:
            return False
        return self._opening(q) < _EMPTY * self._policy.table.block_edge

    def _opening(self, q: Float64) -> float:
        """Return the opening of the active arm's jaws [m]."""
        arm = self._on().arm
        return Opening(jaws(arm)).metres(float(q[gripper_dim(arm)]))

    def _ahead(self, route: Route) -> Float32:
        """Return the next rows of the route; after its end, the last row is repeated."""
        places = round(self._row) + np.arange(self._policy.horizon)
        return route.rows[np.minimum(places, len(route.rows) - 1)].astype(np.float32)

    def _still(self, q: Float64) -> Float32:
        return np.repeat(q[None], self._policy.horizon, axis=0).astype(np.float32)


def joints_apart(robot: Robot) -> Apart:
    """Return a function that computes for each row its largest joint difference from given joints [rad].

    It compares the joints of the URDF except grippers.
    """
    moving = np.concatenate([group.joint_dims[np.array(group.urdf_joints) != ""] for group in robot.groups])

    def apart(arm: Group, rows: Float64, q: Float64) -> Float64:
        return np.asarray(np.abs(rows - q)[:, moving].max(axis=1))

    return apart


def poses_apart(arm: Group, rows: Float64, q: Float64) -> Float64:
    """Return the distance [n] of the arm's end-effector pose at joints `q` from its pose in each row [rad].

    Different joints with the same pose have distance 0. A shift of _ARM metres counts as one radian.
    """
    planned, current = arm.pose(rows), arm.pose(q)
    shift = np.linalg.norm(planned[:, :3] - current[:3], axis=1) / _ARM
    turn = 2 * np.arccos(np.minimum(1.0, np.abs(planned[:, 3:] @ current[3:])))
    return np.asarray(np.maximum(shift, turn))


def _differs(detection: Detection, before: Detection) -> bool:
    """Return True if the block or the plate was detected at another place in `before`."""
    pairs = ((detection.block, before.block), (detection.plate, before.plate))
    return any(now and then and math.dist(now[:2], then[:2]) > _MOVED for now, then in pairs)
