"""Conversion of joint commands to the pose rows that a transport publishes."""

from __future__ import annotations

import numpy as np

from runtime.core.types import Float32, Float64
from runtime.spaces.end_effectors import EndEffectors
from runtime.spaces.pose_rows import PoseRows


class PosePublisher:
    """Converter of each sent joint command [D] to a pose row float32 [W], which continues the previous row."""

    def __init__(self, rows: PoseRows, end_effectors: EndEffectors) -> None:
        self._rows = rows
        self._end_effectors = end_effectors
        self._previous: Float64 | None = None

    def __call__(self, action: Float64) -> Float32:
        joints = action[None]
        row: Float64 = self._rows.encode(self._end_effectors.vectors(joints), joints, self._previous)[0]
        self._previous = row
        return row.astype(np.float32)
