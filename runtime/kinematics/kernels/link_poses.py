"""Poses of all links of a robot, for the 3D scene."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float32, Float64
from runtime.kinematics.kernels.compilation import kernel
from runtime.kinematics.kernels.rotations import compute_sincos


class LinkTable(NamedTuple):
    """Table of links [P], parents first; a link's pose relative to its parent is a function of one joint value.

    The value v is factor * q[drive] + offset, limited to `low` and `high`; it is the offset if `drive` is -1. The pose
    is motions[0] + cos(v) motions[1] + sin(v) motions[2] + v motions[3] with the link's `motions` [4, 12]: a rotation
    row by row, then the origin. `above` is the parent's index, negative for a link without a parent.
    """

    motions: Float64
    drive: NDArray[np.int64]
    factor: Float64
    offset: Float64
    low: Float64
    high: Float64
    above: NDArray[np.int64]


@kernel
def compute_link_poses(parts: LinkTable, q: Float64, placed: Float32) -> None:
    """Write to placed [T, P, 16] the transforms scene <- link, column by column, for joints q [T, D]."""
    count = len(parts.drive)
    frames, turns, own = np.empty((count, 12)), np.empty((3, count)), np.empty(12)
    for row in range(len(q)):
        for part in range(count):
            drive = parts.drive[part]
            value = parts.offset[part] + (parts.factor[part] * q[row, drive] if drive >= 0 else 0.0)
            turns[0, part] = min(max(value, parts.low[part]), parts.high[part])
        compute_sincos(turns)
        for part in range(count):
            value, sine, cosine = turns[0, part], turns[1, part], turns[2, part]
            for k in range(12):
                own[k] = (
                    parts.motions[part, 0, k]
                    + cosine * parts.motions[part, 1, k]
                    + sine * parts.motions[part, 2, k]
                    + value * parts.motions[part, 3, k]
                )
            above = parts.above[part]
            if above < 0:
                for k in range(12):
                    frames[part, k] = own[k]
            else:
                for i in range(3):
                    a, b, c = frames[above, 3 * i], frames[above, 3 * i + 1], frames[above, 3 * i + 2]
                    for j in range(3):
                        frames[part, 3 * i + j] = a * own[j] + b * own[3 + j] + c * own[6 + j]
                    frames[part, 9 + i] = frames[above, 9 + i] + a * own[9] + b * own[10] + c * own[11]
            for j in range(3):
                for i in range(3):
                    placed[row, part, 4 * j + i] = frames[part, 3 * i + j]
                placed[row, part, 4 * j + 3] = 0.0
                placed[row, part, 12 + j] = frames[part, 9 + j]
            placed[row, part, 15] = 1.0
