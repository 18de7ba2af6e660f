"""A scripted policy that keeps an arm's fingertips beside the block on the belt, by what it sees and nothing else.

It does what a policy does that has learnt the task: it takes the block's place from the overhead picture of the
request, and its velocity from the pictures of the requests before; it takes the block to go on like that as far as
the chunk reaches, but not beyond the ends of the belt; it leads by what robots lag behind; and it goes there from
the joints of the request no faster than it is used to. When the belt turns round it cannot know beforehand.
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

LEAD = 0.08  # s by which a row is ahead of its time: what robots lag behind
SPEED = 1.0  # rad/s of each joint on the way to the block, at most
_WINDOW = 0.25  # s of sights that velocity is fitted to; the newest two in any case
_FORGOTTEN = 3.0  # s after which a sight says nothing about velocity any more
_ACROSS = 0.04  # m to either side of the belt's middle that a block is followed
_BEYOND = 0.02  # m to either side of where blocks ride
_NODES = (16, 5)  # of the map from places to joints, along and across the belt


class ChaseScript(Script):
    """The policy for every connection; `places` are those of the belt that it has learnt."""

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
        """A connection that has seen nothing."""
        return ChaseEpisode(self)


class ChaseEpisode:
    """One connection: where the block was seen, and when."""

    def __init__(self, policy: ChaseScript) -> None:
        self._policy = policy
        self._seen: deque[tuple[float, float, float]] = deque(maxlen=64)  # time [s], x, y [m]

    def __call__(self, q: Float64, pictures: Mapping[str, UInt8], prompt: str) -> Float32:
        """Rows float32 [H, D] beside where the block will be; the joints themselves before it was ever seen."""
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
        """Positions along the belt at these times [n], extrapolated from its motion, and positions across."""
        seen = np.array(self._seen)
        newest = seen[-1]
        fitted = seen[(newest[0] - seen[:, 0] <= _WINDOW) | (np.arange(len(seen)) >= len(seen) - 2)]
        since = fitted[:, 0] - fitted[:, 0].mean()
        spread = float(since @ since)
        velocity = float(since @ fitted[:, 1]) / spread if spread > 0 else 0.0
        x = fitted[:, 1].mean() + velocity * (times - fitted[:, 0].mean())
        return np.clip(x, *self._policy.places.belt.x), np.full(len(times), newest[2])


class PlaceMap:
    """From places of the block to joints with fingertips beside it: solved at some, interpolated between."""

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
        """Joints [n, D] for a block at x, y [n], or at the nearest place that is mapped."""
        column, right = _between(self._x, x)
        row, up = _between(self._y, y)
        left, more = (self._joints[column + step] for step in (0, 1))
        pick = np.arange(len(x))
        lower = left[pick, row] + right * (more[pick, row] - left[pick, row])
        upper = left[pick, row + 1] + right * (more[pick, row + 1] - left[pick, row + 1])
        return np.asarray(lower + up * (upper - lower))

    def _solved(self, robot: Robot, postures: Postures, arm: Group) -> Float64 | None:
        """Joints [along, across, D]; None where the arm does not reach one of the places."""
        rest = robot.poses.get("ready", robot.poses["home"])
        dx, dy, height = self.belt.fingertip_offset
        found = []
        for x in self._x:
            for y in self._y:
                joints = postures.hover(arm, rest, (float(x + dx), float(y + dy)), height)
                if joints is None:
                    return None
                found.append(joints)
        return np.array(found).reshape(*_NODES, robot.dim)


def _between(nodes: Float64, values: Float64) -> tuple[np.ndarray, Float64]:
    """The node at or below each value [n], and how far it is from there to the next one [n, 1], from 0 to 1."""
    part = np.clip((values - nodes[0]) / (nodes[1] - nodes[0]), 0.0, len(nodes) - 1.0)
    lower = np.minimum(part.astype(int), len(nodes) - 2)
    return lower, (part - lower)[:, None]
