"""Scripted policy that keeps an arm's fingertips beside the block on the belt, using only its observations.

It acts as a policy that has learnt the task. It detects the block's place in the overhead image of the request, and
estimates its velocity from earlier requests. It extrapolates this motion over the chunk, but not beyond the ends of the
belt. Each row is the place at which the block will be a little later than at the row's step, to compensate for the
robots' lag. The policy approaches from the joints of the request within a speed limit. It cannot predict when the belt
reverses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import SetupError
from runtime.core.types import Float32, Float64, UInt8
from runtime.simulation.bench.bench import Belt, Bench
from runtime.simulation.scripts.detection import OverheadDetector
from runtime.simulation.scripts.pick_place import ScriptError
from runtime.simulation.scripts.postures import Postures
from runtime.simulation.scripts.script import Answer, Script

if TYPE_CHECKING:
    from robots import Group, Robot

LEAD = 0.08  # [s] by which rows are ahead of time, to compensate for the robots' lag
SPEED = 1.0  # [rad/s] highest speed of each joint while approaching the block
_WINDOW = 0.25  # [s] of detections that velocity is fitted to; at least the newest two
_FORGOTTEN = 3.0  # [s] after which a detection is discarded
_ACROSS = 0.04  # [m] range to either side of the belt's middle in which a block is followed
_BEYOND = 0.02  # [m] beyond the range in which blocks ride, at either end
_NODES = (16, 5)  # nodes of the map, along and across the belt


class ChaseScript(Script):
    """Script of the chase policy, which all connections share; each connection gets a `ChaseEpisode` of its own.

    `places` maps positions of a block on the belt to joints.

    Raises:
        SetupError: If no arm of the robot reaches all of the belt.
    """

    def __init__(
        self,
        robot: Robot,
        horizon: int,
        rate: float,
        name: str | None = None,
        clock: Clock | None = None,
        places: PlaceMap | None = None,
    ) -> None:
        self.clock = clock or MonotonicClock()
        self.places = places or PlaceMap(robot, Belt())
        self.overhead = OverheadDetector(robot, Bench(belt=self.places.belt))
        self.times = np.arange(horizon) / rate
        self.metadata = {
            "name": name or "chase",
            "description": "scripted chase of a block on a belt: sees the overhead picture, not a learned policy",
            "action_horizon": horizon,
        }

    def begin(self) -> Answer:
        """Return the function that answers the requests of a new connection, which has not detected a block yet."""
        return ChaseEpisode(self)


class ChaseEpisode:
    """State of one connection: the places at which the block was detected, with the times of detection."""

    def __init__(self, policy: ChaseScript) -> None:
        self._policy = policy
        self._seen: deque[tuple[float, float, float]] = deque(maxlen=64)  # time [s], x, y [m]

    def __call__(self, q: Float64, pictures: Mapping[str, UInt8], prompt: str) -> Float32:
        """Return rows float32 [H, D] beside the block's future places.

        If the block was not detected within the last _FORGOTTEN seconds, all rows are the joints `q`.
        """
        policy, now = self._policy, self._policy.clock.now()
        self._detect(pictures, now)
        if not self._seen:
            return np.repeat(q[None], len(policy.times), axis=0).astype(np.float32)
        x, y = self._ahead(now + policy.times + LEAD)
        reach = SPEED * (policy.times + LEAD)[:, None]
        rows = q + np.clip(policy.places.joints(x, y) - q, -reach, reach)
        return rows.astype(np.float32)

    def _detect(self, pictures: Mapping[str, UInt8], now: float) -> None:
        key = self._policy.overhead.key
        if key not in pictures:
            raise ScriptError(f"the request has no picture {key!r}; it has {', '.join(pictures) or 'none'}")
        block = self._policy.overhead.detect(pictures[key]).block
        while self._seen and now - self._seen[0][0] > _FORGOTTEN:
            self._seen.popleft()
        if block is not None:
            self._seen.append((now, block[0], block[1]))

    def _ahead(self, times: Float64) -> tuple[Float64, Float64]:
        """Return the block's expected places at `times` [n]: positions along the belt [n] and across it [n].

        Positions along the belt are extrapolated; the position across it is the newest one, repeated.
        """
        samples = np.array(self._seen)
        newest = samples[-1]
        fitted = samples[
            (newest[0] - samples[:, 0] <= _WINDOW) | (np.arange(len(samples)) >= len(samples) - 2)
        ]
        since = fitted[:, 0] - fitted[:, 0].mean()
        spread = float(since @ since)
        velocity = float(since @ fitted[:, 1]) / spread if spread > 0 else 0.0
        x = fitted[:, 1].mean() + velocity * (times - fitted[:, 0].mean())
        return np.clip(x, *self._policy.places.belt.x), np.full(len(times), newest[2])


class PlaceMap:
    """Map from places of the block to joints with fingertips beside it: solved on a grid, then interpolated.

    Raises:
        SetupError: If no arm of the robot reaches all of the belt.
    """

    def __init__(self, robot: Robot, belt: Belt) -> None:
        self.belt = belt
        self._x = np.linspace(belt.x[0] - _BEYOND, belt.x[1] + _BEYOND, _NODES[0])
        self._y = belt.y + np.linspace(-_ACROSS, _ACROSS, _NODES[1])
        postures = Postures(robot, Bench(belt=belt))
        for arm in postures.arms:
            solved = self._solved(robot, postures, arm)
            if solved is not None:
                self._joints = solved
                return
        raise SetupError(
            f"no arm of {robot.name} reaches all of the belt from x {belt.x[0]} to {belt.x[1]} m, y {belt.y} m"
        )

    def joints(self, x: Float64, y: Float64) -> Float64:
        """Return the joints [n, D] for a block at x, y [n], or at the nearest place within the grid."""
        column, right = _between(self._x, x)
        row, up = _between(self._y, y)
        left, more = (self._joints[column + step] for step in (0, 1))
        pick = np.arange(len(x))
        lower = left[pick, row] + right * (more[pick, row] - left[pick, row])
        upper = left[pick, row + 1] + right * (more[pick, row + 1] - left[pick, row + 1])
        return np.asarray(lower + up * (upper - lower))

    def _solved(self, robot: Robot, postures: Postures, arm: Group) -> Float64 | None:
        """Return joints [along, across, D] of an arm on the grid; None if it does not reach all places."""
        rest_joints = robot.poses.get("ready", robot.poses["home"])
        dx, dy, height = self.belt.fingertip_offset
        solutions = []
        for x in self._x:
            for y in self._y:
                joints = postures.hover(arm, rest_joints, (float(x + dx), float(y + dy)), height)
                if joints is None:
                    return None
                solutions.append(joints)
        return np.array(solutions).reshape(*_NODES, robot.dim)


def _between(nodes: Float64, values: Float64) -> tuple[np.ndarray, Float64]:
    """Return for each value [n] the node at or below it, and its fraction [n, 1] of the way to the next node."""
    part = np.clip((values - nodes[0]) / (nodes[1] - nodes[0]), 0.0, len(nodes) - 1.0)
    lower = np.minimum(part.astype(int), len(nodes) - 2)
    return lower, (part - lower)[:, None]
