"""Motion of a belt: strokes to and fro of random lengths and speeds, drawn from a seed, so that no policy can predict
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.bench import Belt, BenchError

SPEED = (0.06, 0.10)  # [m/s] of a stroke, lowest and highest
SHORTEST = 0.10  # [m] of a stroke
ACCELERATION = 0.6  # [m/s^2] of the belt


@dataclass(frozen=True, slots=True, eq=False)
class BeltMotion:
    """Consecutive pieces of constant acceleration, described by `knots` [n, 4].

    The columns are time [s], x [m], speed [m/s] and acceleration [m/s^2]. The belt is at rest before the first and
    after the last knot.
    """

    knots: Float64

    @property
    def duration(self) -> float:
        """Time until the belt stops for good [s]."""
        return float(self.knots[-1, 0])

    @property
    def changes(self) -> tuple[float, ...]:
        """Times at which the belt begins to change its speed [s]."""
        return tuple(self.knots[self.knots[:, 3] != 0.0, 0].tolist())

    def x(self, seconds: float) -> float:
        """Return the position [m] of a block on the belt, `seconds` after the start of the motion."""
        seconds = min(max(seconds, 0.0), self.duration)
        start, x, speed, acceleration = self.knots[
            int(np.searchsorted(self.knots[:, 0], seconds, "right")) - 1
        ]
        passed = seconds - start
        return float(x + speed * passed + acceleration * passed * passed / 2)


def draw_belt_motion(seed: int, belt: Belt, seconds: float) -> BeltMotion:
    """Return the motion that `seed` decides, the same for the same arguments; after `seconds` the belt brakes to a
    stop.

    Raises:
        BenchError: If the belt is too short for two of the shortest strokes and its stopping distances.
    """
    low, high = belt.x
    room = SPEED[1] ** 2 / ACCELERATION  # twice the longest stopping distance
    if high - low < 2 * (SHORTEST + room):
        raise BenchError(
            f"a belt of {high - low:.3f} m was given; allowed: {2 * (SHORTEST + room):.3f} m or more"
        )
    chance = np.random.default_rng(seed)
    x = float(chance.uniform(low + room, high - room))
    run = _BeltMotionBuilder([], 0.0, x, 0.0)
    while run.time < seconds:
        ends = chance.uniform(low + room, high - room, 64)
        end = float(ends[np.abs(ends - run.x) >= SHORTEST][0])
        speed = math.copysign(float(chance.uniform(*SPEED)), end - run.x)
        run.change(speed)
        run.cruise(min(abs(end - run.x) / abs(speed), seconds - run.time))
    run.change(0.0)
    run.knots.append((run.time, run.x, 0.0, 0.0))
    return BeltMotion(np.array(run.knots))


@dataclass(slots=True)
class _BeltMotionBuilder:
    """Belt motion under construction: `knots` describe it up to `time` [s].

    At that time a block on the belt is at `x` [m] and moves at `speed` [m/s].
    """

    knots: list[tuple[float, float, float, float]]
    time: float
    x: float
    speed: float

    def change(self, speed: float) -> None:
        """Change the belt's speed to `speed` [m/s] at constant acceleration."""
        seconds = abs(speed - self.speed) / ACCELERATION
        self._piece(seconds, math.copysign(ACCELERATION, speed - self.speed))
        self.speed = speed

    def cruise(self, seconds: float) -> None:
        """Continue at the present speed."""
        self._piece(seconds, 0.0)

    def _piece(self, seconds: float, acceleration: float) -> None:
        if seconds > 0:
            self.knots.append((self.time, self.x, self.speed, acceleration))
            self.x += self.speed * seconds + acceleration * seconds * seconds / 2
            self.time += seconds
