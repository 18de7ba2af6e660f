"""Room that the arms of a robot leave each other, and its body, on a way."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from robots.clearance import MARGIN, get_clearance
from robots.description import TABLE
from runtime.core.types import Float64

if TYPE_CHECKING:
    from robots import Robot

_LOOKS = 48  # postures of a way that are looked at
_BETWEEN = 0.03  # m that arms leave each other
_OWN = MARGIN + 0.001  # m that an arm leaves between its links, and to the body that it stands on


class Clearance:
    """Clearance that safety would warn of, with some margin; without the table, for hands go down to it."""

    def __init__(self, robot: Robot) -> None:
        self._clearance = get_clearance(robot)
        pairs = self._clearance.pairs
        arms = {arm.name for arm in robot.arms}
        owners = [{part.partition("/")[0] for part in pair} & arms for pair in pairs]
        self._links = np.array(
            [index for index, pair in enumerate(pairs) if TABLE not in pair], dtype=np.intp
        )
        wanted = np.array([_BETWEEN if len(owner) > 1 else _OWN for owner in owners])
        self._wanted = wanted[self._links]

    def margin_along(self, rows: Float64) -> float:
        """Room on the way float64 [n, D] beyond what there should be, at its narrowest [m]."""
        if not len(self._links):
            return np.inf
        looked_at = rows[:: max(1, len(rows) // _LOOKS)]
        return float((self._clearance.distances(looked_at)[:, self._links] - self._wanted).min())


@lru_cache(maxsize=32)  # cache: reads the meshes of a robot, which do not change
def clearance_for(robot: Robot) -> Clearance:
    """That of a robot, made once."""
    return Clearance(robot)
