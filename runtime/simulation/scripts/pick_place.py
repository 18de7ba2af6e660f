"""A scripted policy that picks the block up and puts it on the plate, by what it sees and nothing else.

Where the block and the plate are it takes from the overhead picture of the request; how far it has come, from the
joints in it. Between the requests of one connection it remembers the route it is on and when it was where: a leg
ends when the joints are there, a gate when the measured jaws have obeyed, and rows run on with the time between
requests, so that a chunk continues the one before it whatever the delay.
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

_LEAD = 0.12  # s by which rows lead the measured joints where time does not tell: what robots lag behind
_BEHIND, _AHEAD = 0.8, 0.6  # s between the row of the clock and that of the joints, beyond which they win
_FAR = 0.2  # rad between the row of the clock and the joints, beyond which they win
_THERE = 0.015  # rad from the end of a leg
_LOST = 0.35  # rad from a leg: something else has moved the robot
_MOVED = 0.025  # m; a block that lies elsewhere is another scene
_MARGIN = 0.01  # m inside the plate's rim that a block's middle has to be
_GRIPPED = 1.25  # of the block's edge: jaws narrower than that have closed on it, or on nothing
_EMPTY = 0.75  # of the block's edge: jaws narrower than that hold nothing
_SHORT = 0.05  # m by which a grasp is short where it slips
_CARRYING = ("lift", "carry", "lower")
_LEAVING = ("back off", "retreat")
_COMING = ("make way", "reach")
_ARM = 0.25  # m
_PAUSED = 3.0  # s without a request, after which a robot that was leaving begins another episode


Apart = Callable[["Group", Float64, Float64], Float64]
"""From the arm that moves, rows float64 [n, D] and joints [D] to how far apart they are [n], in rad."""


class ScriptError(RuntimeFault):
    """A request that a script cannot answer."""


@dataclass(frozen=True, slots=True)
class Skill:
    """Skill of the policy: `noise` [m] on the block's place in each attempt, one sigma in x and in y.

    A block's edge of noise is one radian of it on the block's turn. `failure_rate` is the probability that in
    an episode it lets the block go on the way or always grasps short; `seed` decides both, episode by episode.
    """

    noise: float = 0.0
    failure_rate: float = 0.0
    seed: int = 0


class PickPlace(Script):
    """The policy for every connection; episodes are counted over all of them, so that no two are alike."""

    def __init__(
        self,
        robot: Robot,
        horizon: int,
        rate: float,
        skill: Skill,
        name: str | None = None,
        clock: Clock | None = None,
        apart: Apart | None = None,
    ) -> None:
        self.robot, self.clock = robot, clock or MonotonicClock()
        self.apart = apart or joints_apart(robot)
        self.horizon, self.rate, self.skill = horizon, rate, skill
        self.table = Bench()
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
        """A connection that remembers nothing."""
        return PickPlaceEpisode(self)

    def next_episode_noise(self) -> EpisodeNoise:
        """Luck of the next episode."""
        return EpisodeNoise(self.skill, next(self._episodes), self.table.block_edge)


class EpisodeNoise:
    """The chances of one episode: the same for the same seed and number."""

    def __init__(self, skill: Skill, episode: int, edge: float) -> None:
        self._chance = np.random.default_rng([skill.seed, episode])
        self._noise = skill.noise * np.array([1.0, 1.0, 1.0 / edge])
        fails, lets_go = self._chance.random(2)
        slips = fails < skill.failure_rate
        self.slip = PlannedFailure(_SHORT * (slips and lets_go >= 0.5), bool(slips and lets_go < 0.5))

    def perceive(self, block: tuple[float, float, float]) -> tuple[float, float, float]:
        """The block's place and turn as one attempt takes them to be."""
        x, y, yaw = np.array(block) + self._chance.normal(0.0, self._noise)
        return float(x), float(y), float(yaw)


class PickPlaceEpisode:
    """One connection's errand: no route, or a route and how far along it the robot is."""

    def __init__(self, policy: PickPlace) -> None:
        self._policy = policy
        self._prompt = ""
        self._luck: EpisodeNoise | None = None
        self._resigned = False  # the episode has failed; it knows, and does nothing more about it
        self._left: Detection | None = None  # how things lay when it resigned
        self._route: Route | None = None
        self._seen = Detection()  # where things were when the route was made
        self._leg = 0
        self._row = 0.0  # of the whole route, at the last request
        self._asked = 0.0  # s, the last request

    def __call__(self, q: Float64, pictures: Mapping[str, UInt8], prompt: str) -> Float32:
        """Rows float32 [H, D]: the rest of the route, or the joints themselves where there is nothing to do."""
        sight = self._detect(pictures)
        now = self._policy.clock.now()
        elapsed, self._asked = now - self._asked, now
        if prompt != self._prompt or self._is_over(elapsed) or self._elsewhere(q, sight):
            self._forget()
        self._prompt = prompt
        if sight.dark:
            return self._still(q)
        self._advance(q, elapsed)
        if self._misses(q):
            self._follow_route(self._policy.planner.retreat(q, self._on().arm))
        if self._route is None:
            self._decide(q, sight)
        return self._still(q) if self._route is None else self._ahead(self._route)

    def _detect(self, pictures: Mapping[str, UInt8]) -> Detection:
        key = self._policy.overhead.key
        if key not in pictures:
            raise ScriptError(f"the request has no picture {key!r}; it has {', '.join(pictures) or 'none'}")
        return self._policy.overhead.detect(pictures[key])

    # --- deciding ------------------------------------------------------------------------------------------

    def _decide(self, q: Float64, sight: Detection) -> None:
        """Make a route if there is a block to pick, a plate to put it on, and it is not there already."""
        if sight.block is None or sight.plate is None:
            return
        if math.dist(sight.block[:2], sight.plate) < self._policy.table.plate_radius - _MARGIN:
            self._forget()
            return
        if self._resigned:
            self._left = self._left or sight
            if not _differs(sight, self._left):
                return
            self._forget()
        if self._luck is None:
            self._luck = self._policy.next_episode_noise()
        block = self._luck.perceive(sight.block)
        route = self._policy.planner.pick_and_place(q, block, sight.plate, self._luck.slip)
        if route is not None:
            self._seen = sight
            self._follow_route(route)

    def _follow_route(self, route: Route | None) -> None:
        self._route, self._leg, self._row = route, 0, 0.0

    def _forget(self) -> None:
        self._luck = self._left = None
        self._resigned = False
        self._follow_route(None)

    def _is_over(self, pause: float) -> bool:
        """True if another episode follows the pause [s]: nothing was going on any more before it."""
        leaving = self._route is None or self._route.legs[self._leg].name in _LEAVING
        return leaving and pause > _PAUSED

    def _elsewhere(self, q: Float64, sight: Detection) -> bool:
        """True if robot or things are not where they should be in the episode so far."""
        if self._route is None:
            return False
        return self._distances(q).min() > _LOST or (
            self._route.legs[self._leg].name in _COMING and _differs(sight, self._seen)
        )

    # --- following -----------------------------------------------------------------------------------------

    def _on(self) -> Route:
        assert self._route is not None
        return self._route

    def _distances(self, q: Float64) -> Float64:
        """Of the joints [D] from each row of the present leg [rad]."""
        return self._apart(self._on().legs[self._leg].rows, q)

    def _apart(self, rows: Float64, q: Float64) -> Float64:
        route = self._on()
        movers = route.legs[self._leg].others or (route.arm,)
        return np.asarray(np.max([self._policy.apart(arm, rows, q) for arm in movers], axis=0))

    def _advance(self, q: Float64, elapsed: float) -> None:
        """Find the leg and the row that the robot is at; a route that is done is dropped."""
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
        """The row that time has come to, unless the joints say that the robot was held up or moved on."""
        route, rate = self._on(), self._policy.rate
        leg, start = route.legs[self._leg], route.starts[self._leg]
        jaw = gripper_dim(route.arm)
        away = np.abs(leg.rows[:, jaw] - q[jaw]) if leg.gate else self._distances(q)
        seen = start + int(away.argmin())
        near = self._apart(route.rows[[min(round(row), len(route.rows) - 1)]], q)[0] <= _FAR
        if not (near and seen - _BEHIND * rate <= row <= seen + _AHEAD * rate):
            row = seen + _LEAD * rate
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
        """True if the jaws are empty on a leg on which they should hold the block."""
        if self._route is None or self._route.legs[self._leg].name not in _CARRYING:
            return False
        return self._opening(q) < _EMPTY * self._policy.table.block_edge

    def _opening(self, q: Float64) -> float:
        """Of the jaws at work [m]."""
        arm = self._on().arm
        return Opening(jaws(arm)).metres(float(q[gripper_dim(arm)]))

    def _ahead(self, route: Route) -> Float32:
        """The next rows of the route; its last one is repeated."""
        wanted = round(self._row) + np.arange(self._policy.horizon)
        return route.rows[np.minimum(wanted, len(route.rows) - 1)].astype(np.float32)

    def _still(self, q: Float64) -> Float32:
        return np.repeat(q[None], self._policy.horizon, axis=0).astype(np.float32)


def joints_apart(robot: Robot) -> Apart:
    """Function for joints' largest distance [rad] to each row; grippers and numbers without a link aside."""
    moving = np.concatenate([group.joint_dims[np.array(group.urdf_joints) != ""] for group in robot.groups])

    def apart(arm: Group, rows: Float64, q: Float64) -> Float64:
        return np.asarray(np.abs(rows - q)[:, moving].max(axis=1))

    return apart


def poses_apart(arm: Group, rows: Float64, q: Float64) -> Float64:
    """Distance of the arm's end effector from its pose in each of the rows, whatever its joints are [rad].

    A way of _ARM metres counts as one radian.
    """
    wanted, found = arm.pose(rows), arm.pose(q)
    shift = np.linalg.norm(wanted[:, :3] - found[:3], axis=1) / _ARM
    turn = 2 * np.arccos(np.minimum(1.0, np.abs(wanted[:, 3:] @ found[3:])))
    return np.asarray(np.maximum(shift, turn))


def _differs(sight: Detection, before: Detection) -> bool:
    """True if the block or the plate is seen where it was not."""
    pairs = ((sight.block, before.block), (sight.plate, before.plate))
    return any(now and then and math.dist(now[:2], then[:2]) > _MOVED for now, then in pairs)
