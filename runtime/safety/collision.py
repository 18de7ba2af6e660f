"""Collision checks of a robot with itself and the table, for single actions and whole paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robots import Robot
from robots.clearance import get_clearance
from runtime.core.sentences import Pattern
from runtime.core.types import Float64

_WOULD_COLLIDE = Pattern("safety.would_collide", "{one} and {other} would collide ({mm:.0f} mm deep)")
_WOULD_BE_NEAR = Pattern("safety.would_be_near", "{one} and {other} would be {mm:.0f} mm apart")

_NEARER = 1e-6  # [m] rounding tolerance


@dataclass(frozen=True, slots=True)
class Collision:
    """Two links ("left_arm/link5"), or a link and "table", that touch or nearly touch.

    `distance` is the distance between the capsules that model them [m], negative if they overlap.
    """

    first: str
    second: str
    distance: float

    def __str__(self) -> str:
        if self.distance < 0:
            return _WOULD_COLLIDE(one=self.first, other=self.second, mm=-1000 * self.distance)
        return _WOULD_BE_NEAR(one=self.first, other=self.second, mm=1000 * self.distance)


class Collisions:
    """Collision checker for joint vectors float64 [D]: links closer than `margin` [m] count as touching.

    A pair that touches already may keep its distance or separate; only a further approach is forbidden. Grippers are
    not restricted: the purpose is to separate arms, and releasing an object must be possible everywhere.
    """

    def __init__(self, robot: Robot, margin: float) -> None:
        self._clearance = get_clearance(robot)
        self._least = self._clearance.touch_thresholds(margin)
        self._grippers = np.array(robot.gripper_dims, dtype=np.intp)

    def nearest(self, q: Float64) -> Collision | None:
        """Return the closest of the pairs that are within the margin, None if there is no such pair."""
        apart = self._clearance.distances(q)
        return self._worst(apart, apart < self._least)

    def closer_pair(self, q: Float64, before: Float64) -> Collision | None:
        """Return the closest pair that touches at `q` and is nearer than at `before`, None if there is none."""
        apart = self._clearance.distances(q)
        touching = apart < self._least
        if not touching.any():
            return None
        return self._worst(
            apart, touching & (apart < self._clearance.distances(self._gripping(before, q)) - _NEARER)
        )

    def first_on_path(self, way: Float64) -> tuple[Collision, int] | None:
        """Return the first pair that approaches while touching, and its row in `way` [T, D]; None if there is no such
        pair.

        The path is checked with the grippers of its first row and with those of its last row, because grippers may move
        at any time.
        """
        hits = [hit for end in self._ends(way) if (hit := self._hit(self._gripping(way, end))) is not None]
        return min(hits, key=lambda hit: hit[1], default=None)

    def _ends(self, path: Float64) -> Sequence[Float64]:
        same = np.array_equal(path[0, self._grippers], path[-1, self._grippers])
        return (path[0],) if same else (path[0], path[-1])

    def _hit(self, path: Float64) -> tuple[Collision, int] | None:
        apart = self._clearance.distances(path)  # [T, K]
        farthest = np.maximum.accumulate(apart, axis=0)
        wrong = (apart < self._least) & (apart < farthest - _NEARER)
        if not wrong.any():
            return None
        at = int(wrong.any(axis=1).argmax())
        worst = self._worst(apart[at], wrong[at])
        assert worst is not None
        return worst, at

    def _gripping(self, q: Float64, like: Float64) -> Float64:
        """Return `q` with its gripper positions replaced by those of `like`."""
        if not len(self._grippers):
            return q
        gripping = q.copy()
        gripping[..., self._grippers] = like[self._grippers]
        return gripping

    def _worst(self, apart: Float64, among: NDArray[np.bool_]) -> Collision | None:
        if not among.any():
            return None
        index = int(np.where(among, apart, np.inf).argmin())
        first, second = self._clearance.pairs[index]
        return Collision(first, second, float(apart[index]))
