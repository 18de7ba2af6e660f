"""Poses of a description as read-only vectors [7] = x, y, z, qw, qx, qy, qz."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robots.description import PlaceTable
from robots.errors import RobotError
from robots.rotations import Float64


def read_only(numbers: Sequence[float]) -> Float64:
    array = np.array(numbers, dtype=np.float64)
    array.setflags(write=False)
    return array


def pose_vector(key: str, table: PlaceTable | None) -> Float64:
    if table is None:
        return read_only([0, 0, 0, 1, 0, 0, 0])
    return read_only([*table.xyz, *unit_quaternion(f"{key}.wxyz", table.wxyz)])


def unit_quaternion(key: str, wxyz: list[float]) -> list[float]:
    norm = float(np.linalg.norm(wxyz))
    if abs(norm - 1) > 1e-6:
        raise RobotError(f"{key} has length {norm}; allowed: 1 within 1e-6")
    return [part / norm for part in wxyz]
