"""Poses of fingertips that point down, and paths between such poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from runtime.core.types import Float64

_STRIDE, _SWING = 0.04, 0.25  # [m], [rad] largest distance between two poses of a path

Place = tuple[float, float]


@dataclass(frozen=True, slots=True)
class DownwardTip:
    """Pose of fingertips that point down, at the height `height` [m] above `place`.

    The fingers are tilted outwards from the arm by the angle `tilt` [rad], in the direction `bearing` [rad]. The jaws
    open along the direction `yaw` [rad].
    """

    place: Place
    height: float
    yaw: float
    bearing: float
    tilt: float

    def tip(self) -> Float64:
        """Return the fingertips' frame [4, 4] in the world."""
        sine, cosine = math.sin(self.tilt), math.cos(self.tilt)
        ahead = np.array([sine * math.cos(self.bearing), sine * math.sin(self.bearing), -cosine])
        across = np.array([math.cos(self.yaw), math.sin(self.yaw), 0.0])
        across -= ahead * (across @ ahead)
        across /= np.linalg.norm(across)
        tip = np.eye(4)
        tip[:3, :3] = np.column_stack([np.cross(across, ahead), across, ahead])
        tip[:3, 3] = *self.place, self.height
        return tip

    def interpolate(self, other: DownwardTip) -> Iterator[DownwardTip]:
        """Yield the poses on the path to the pose `other`, without both ends."""
        numbers = np.array([*self.place, self.height, self.yaw, self.bearing, self.tilt])
        change = np.array([*other.place, other.height, other.yaw, other.bearing, other.tilt]) - numbers
        change[3:5] = [math.remainder(turn, 2 * math.pi) for turn in change[3:5]]
        count = max(
            math.ceil(float(np.linalg.norm(change[:3])) / _STRIDE),
            math.ceil(float(np.abs(change[3:]).max()) / _SWING),
        )
        for step in range(1, count):
            x, y, *orientation = (numbers + change * step / count).tolist()
            yield DownwardTip((x, y), *orientation)
