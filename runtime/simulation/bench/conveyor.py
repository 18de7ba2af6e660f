"""The simulated conveyor: a block rides to and fro on a belt, and fingertips are to stay beside it.

The belt stands until fingertips are beside the block for the first time: whoever follows it begins from the same
situation, however long the way there took. Then it runs its course, which the seed decides and nothing foretells.
All that counts is where the fingertips are meanwhile, at every step of the physics: a block's half edge from
their place beside it they point past it. Pushed off the belt or taken from it the block rides no more, and the
task cannot be done.
"""

from __future__ import annotations

import math
from bisect import bisect_right, insort
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.belt_motion import BeltMotion, draw_belt_motion
from runtime.simulation.bench.bench import (
    Belt,
    Bench,
    BenchError,
    BenchLayout,
)
from runtime.simulation.bench.tabletop import ResetRequest, Tabletop

if TYPE_CHECKING:
    from robots import Robot

COURSE_S = 20.0
TOLERANCE_M = 0.02  # half of a block's edge
REQUIRED = 2 / 3  # of the time of the course, within the tolerance
CONVEYOR = Bench(belt=Belt())
_PLATE = (-0.05, 0.18)  # aside: nothing is to be put there
_ON_BELT = 1e-3  # m above the belt, at most


@dataclass(slots=True)
class TrackingErrors:
    """Fingertips' tracking of the block: distances [m] from their place beside it, in order of size."""

    distances: list[float] = field(default_factory=list)
    total: float = 0.0  # m

    def add(self, distance: float) -> None:
        """One more step of the physics."""
        insort(self.distances, distance)
        self.total += distance

    @property
    def on_target_share(self) -> float:
        """Of the time, within the tolerance; 0 before there was any."""
        return bisect_right(self.distances, TOLERANCE_M) / max(1, len(self.distances))

    @property
    def mean(self) -> float:
        """Of the distances [m]; 0 before there were any."""
        return self.total / max(1, len(self.distances))

    def quantile(self, part: float) -> float:
        """The distance [m] that is not exceeded for this part of the time; 0 before there were any."""
        if not self.distances:
            return 0.0
        return self.distances[max(0, math.ceil(part * len(self.distances)) - 1)]


class Conveyor(Tabletop):
    """A belt, a block on it, a plate aside; what fingers do to the block they do as on any tabletop.

    `escort` is about the course since the last reset.
    """

    step = 1 / 59  # s; nothing is to be grasped here, two steps to a tick at 30 Hz are enough

    def __init__(self, robot: Robot, seed: int) -> None:
        assert CONVEYOR.belt is not None
        self.belt = CONVEYOR.belt
        super().__init__(robot, seed, bench=CONVEYOR)

    @property
    def running(self) -> bool:
        """True if the belt has been started and still runs."""
        return self._reached["beside"] and not self.over

    @property
    def over(self) -> bool:
        """True if the course has been run to its end."""
        return self._elapsed >= self._course.duration

    @property
    def success(self) -> bool:
        """True if the course is over and fingertips were in their place for long enough."""
        return self.over and self.escort.on_target_share >= REQUIRED

    def truth(self) -> dict[str, object]:
        """The node's report of its bench; `chase` covers the course since the last reset, in mm and s."""
        distance = self.distance()
        return super().truth() | {
            "milestones": {"reached": self._reached["beside"], "followed": self.success},
            "success": self.success,
            "chase": {
                "seconds": self._elapsed,
                "share": self.escort.on_target_share,
                "distance": 1e3 * distance if math.isfinite(distance) else None,
                "mean": 1e3 * self.escort.mean,
                "p95": 1e3 * self.escort.quantile(0.95),
                "tolerance": 1e3 * TOLERANCE_M,
                "required": REQUIRED,
            },
        }

    def distance(self) -> float:
        """From the nearest fingertips to their place beside the block [m]; inf before anything has moved."""
        block = self._blocks[0].pose[:3, 3] - (0.0, 0.0, self.bench.block_edge / 2)
        place = block + self.belt.fingertip_offset
        tips = [hand.tip[:3, 3] for hand in self._hands.values()]
        return min((float(np.linalg.norm(tip - place)) for tip in tips), default=math.inf)

    def _layout(self, wish: ResetRequest) -> BenchLayout:
        if wish.positions:
            raise BenchError(
                f"positions name {', '.join(sorted(map(str, wish.positions)))}; "
                "allowed on a conveyor: none, the seed decides where the block rides"
            )
        self._course: BeltMotion = draw_belt_motion(wish.seed, self.belt, COURSE_S)
        self._elapsed = 0.0
        self.escort = TrackingErrors()
        return BenchLayout(((self._course.x(0.0), self.belt.y, 0.0),), _PLATE)

    def _place_objects(self, wish: ResetRequest) -> None:
        super()._place_objects(wish)
        self._reached = {"beside": False}

    def _step(self, q: Float64, seconds: float) -> None:
        if self.running:
            self._run(seconds)
        super()._step(q, seconds)
        self._measure()

    def _run(self, seconds: float) -> None:
        """The belt goes on, and takes the block along where it lies on it."""
        before, self._elapsed = self._elapsed, min(self._elapsed + seconds, self._course.duration)
        block = self._blocks[0]
        aside = abs(block.pose[1, 3] - self.belt.y)
        if not block.held_by and aside < self.belt.width / 2 and block.bottom < _ON_BELT:
            block.shift(np.array([self._course.x(self._elapsed) - self._course.x(before), 0.0]))

    def _note(self) -> None:
        """Nothing is to be lifted or carried here."""

    def _measure(self) -> None:
        """Note where the fingertips are, while the belt runs; start it where they are beside the block."""
        distance = self.distance()
        if self.running:
            self.escort.add(distance)
        self._reached["beside"] |= distance <= TOLERANCE_M
