"""Simulated conveyor: a block rides to and fro on a belt, and fingertips have to stay next to it.

The belt starts when fingertips are next to the block for the first time, so that every attempt begins from the same
situation, however long its approach took. It then runs a motion that the seed decides and that cannot be predicted. The
score is the share of physics steps in which fingertips are within tolerance of their place beside the block. The
tolerance is half a block's edge, because from farther away the fingertips point past the block. A block that was pushed
or picked off the belt no longer rides, and the task cannot be completed then.
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
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.tabletop import Tabletop

if TYPE_CHECKING:
    from robots import Robot

COURSE_S = 20.0  # from the start of the belt until it brakes
TOLERANCE_M = 0.02  # half of a block's edge length
REQUIRED = 2 / 3  # share of steps within the tolerance
CONVEYOR = Bench(belt=Belt())
_PLATE = (-0.05, 0.18)  # out of the way: the task does not use it
_ON_BELT = 1e-3  # [m] greatest height above the belt at which a block rides


@dataclass(slots=True)
class TrackingErrors:
    """Distances of the fingertips from their place beside the block [m], one per physics step, sorted."""

    distances: list[float] = field(default_factory=list)
    total: float = 0.0  # [m]

    def add(self, distance: float) -> None:
        """Add the distance [m] of one physics step."""
        insort(self.distances, distance)
        self.total += distance

    @property
    def on_target_share(self) -> float:
        """Share of steps within the tolerance; 0 before the first step."""
        return bisect_right(self.distances, TOLERANCE_M) / max(1, len(self.distances))

    @property
    def mean(self) -> float:
        """Mean of all distances so far [m]; 0 before the first step."""
        return self.total / max(1, len(self.distances))

    def quantile(self, part: float) -> float:
        """Return the distance [m] that is not exceeded in the share `part` of steps; 0 before the first step."""
        if not self.distances:
            return 0.0
        return self.distances[max(0, math.ceil(part * len(self.distances)) - 1)]


class Conveyor(Tabletop):
    """Tabletop with a belt, a block on the belt, and a plate out of the way; fingers move the block as on any tabletop.

    `escort` has the tracking errors since the last reset.
    """

    step = 1 / 59  # [s]; without grasping, two steps per tick at 30 Hz are enough

    def __init__(self, robot: Robot, seed: int) -> None:
        assert CONVEYOR.belt is not None
        self.belt = CONVEYOR.belt
        super().__init__(robot, seed, bench=CONVEYOR)

    @property
    def running(self) -> bool:
        """Whether the belt has been started and still runs."""
        return self._beside and not self.over

    @property
    def over(self) -> bool:
        """Whether the belt's motion has ended."""
        return self._elapsed >= self._course.duration

    @property
    def success(self) -> bool:
        """Whether the motion has ended and fingertips were in their place for a sufficient share of it."""
        return self.over and self.escort.on_target_share >= REQUIRED

    def truth(self) -> dict[str, object]:
        """Return the ground truth that is published with an observation.

        Its entry `chase` has the time since the belt started [s], the share of steps within tolerance, and the
        distances of the fingertips from their moving target position beside the block [mm].
        """
        distance = self.distance()
        return super().truth() | {
            "milestones": {"reached": self._beside, "followed": self.success},
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
        """Return the distance of the nearest fingertips from their place beside the block [m]; inf before the first
        step.
        """
        block = self._blocks[0].pose[:3, 3] - (0.0, 0.0, self.bench.block_edge / 2)
        place = block + self.belt.fingertip_offset
        tips = [hand.tip[:3, 3] for hand in self._hands.values()]
        return min((float(np.linalg.norm(tip - place)) for tip in tips), default=math.inf)

    def _layout(self, wish: ResetRequest) -> BenchLayout:
        if wish.factors:
            raise BenchError(f"factors name {', '.join(map(str, wish.factors))}; allowed on a conveyor: none")
        if wish.positions:
            raise BenchError(
                f"positions name {', '.join(sorted(map(str, wish.positions)))}; "
                "allowed on a conveyor: none, the seed decides where the block rides"
            )
        self._course: BeltMotion = draw_belt_motion(wish.seed, self.belt, COURSE_S)
        self._elapsed = 0.0
        self.escort = TrackingErrors()
        return BenchLayout(((self._course.x(0.0), self.belt.y, 0.0),), (_PLATE,))

    def _place_objects(self, wish: ResetRequest) -> None:
        super()._place_objects(wish)
        self._beside = False

    def _step(self, q: Float64, seconds: float) -> None:
        if self.running:
            self._run(seconds)
        super()._step(q, seconds)
        self._measure()

    def _run(self, seconds: float) -> None:
        """Advance the belt by `seconds`, and with it a block that lies on it."""
        before, self._elapsed = self._elapsed, min(self._elapsed + seconds, self._course.duration)
        block = self._blocks[0]
        offset = abs(block.pose[1, 3] - self.belt.y)
        if not block.held_by and offset < self.belt.width / 2 and block.bottom < _ON_BELT:
            block.shift(np.array([self._course.x(self._elapsed) - self._course.x(before), 0.0]))

    def _note(self) -> None:
        """Do nothing, because a conveyor has no milestones of lifting and carrying."""

    def _measure(self) -> None:
        """Add the fingertips' distance to the tracking errors if the belt runs.

        The belt is started as soon as the fingertips are within tolerance of their place beside the block.
        """
        distance = self.distance()
        if self.running:
            self.escort.add(distance)
        self._beside |= distance <= TOLERANCE_M
