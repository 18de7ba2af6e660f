"""Clearance between a robot's arms, and between arms and body, along a path."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from robots.clearance import MARGIN, get_clearance
from robots.description import TABLE
from runtime.core.types import Float64

if TYPE_CHECKING:
    from robots import Robot

_LOOKS = 48  # least number of postures that are checked on a longer path
_BETWEEN = 0.03  # [m] required between two arms
_OWN = MARGIN + 0.001  # [m] required between an arm's links, and between arm and body


class Clearance:
    """Clearance of a robot along paths, relative to a required distance larger than that at which safety warns.

    The table does not count, because hands go down to it.
    """

    def __init__(self, robot: Robot) -> None:
        self._clearance = get_clearance(robot)
        pairs = self._clearance.pairs
        arms = {arm.name for arm in robot.arms}
        owners = [{part.partition("/")[0] for part in pair} & arms for pair in pairs]
        self._links = np.array(
            [index for index, pair in enumerate(pairs) if TABLE not in pair], dtype=np.intp
        )
        required = np.array([_BETWEEN if len(owner) > 1 else _OWN for owner in owners])
        self._wanted = required[self._links]

    def margin_along(self, rows: Float64) -> float:
        """Return the smallest difference between clearance and required clearance along a path float64 [n, D] [m].

        inf if there are no pairs of links to check.
        """
        if not len(self._links):
            return np.inf
        looked_at = rows[:: max(1, len(rows) // _LOOKS)]
        return float((self._clearance.distances(looked_at)[:, self._links] - self._wanted).min())


@lru_cache(maxsize=32)  # cache: reads the meshes of a robot, which do not change
def clearance_for(robot: Robot) -> Clearance:
    """Return the cached clearance of a robot."""
    return Clearance(robot)
