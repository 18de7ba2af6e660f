"""The poses that a joint command amounts to, as a transport takes them."""

from __future__ import annotations

import numpy as np

from runtime.core.types import Float32, Float64
from runtime.spaces.end_effectors import EndEffectors
from runtime.spaces.pose_rows import PoseRows


class PosePublisher:
    """Called with every joint command [D] that is sent: float32 [W], each row continuing the one before."""

    def __init__(self, rows: PoseRows, end_effectors: EndEffectors) -> None:
        self._rows = rows
        self._end_effectors = end_effectors
        self._previous: Float64 | None = None

    def __call__(self, action: Float64) -> Float32:
        joints = action[None]
        row: Float64 = self._rows.encode(self._end_effectors.vectors(joints), joints, self._previous)[0]
        self._previous = row
        return row.astype(np.float32)
