"""Poses of all links of a robot in the format of the 3D scene, computed within microseconds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robots import Body
from runtime.core.types import Float32
from runtime.kinematics.base import KinematicsError

if TYPE_CHECKING:
    from runtime.kinematics.kernels.link_poses import LinkTable


class LinkPoses:
    """Calculator of the poses of a body's links, in its order; the kernel is compiled or loaded on construction.

    Raises:
        KinematicsError: numba is not installed.
    """

    def __init__(self, body: Body) -> None:
        try:
            from runtime.kinematics.kernels.link_poses import compute_link_poses
        except ImportError as error:
            raise KinematicsError(str(error)) from error
        self._place = compute_link_poses
        self._parts = _parts_of(body)
        self._dim = body.tables.coupling.shape[1]
        self.poses(np.zeros(self._dim))

    def poses(self, q: ArrayLike) -> Float32:
        """Return the transforms scene <- link for joints [..., D]: float32 [..., P, 16], column by column.

        Raises:
            KinematicsError: The joint vectors have another width.
        """
        joints = np.array(q, dtype=np.float64, order="C")
        if joints.shape[-1:] != (self._dim,):
            raise KinematicsError(f"joints of shape {joints.shape} were given; allowed: [..., {self._dim}]")
        placed = np.empty((*joints.shape[:-1], len(self._parts.drive), 16), dtype=np.float32)
        rows = joints.reshape(-1, self._dim)
        self._place(self._parts, rows, placed.reshape(len(rows), len(self._parts.drive), 16))
        return placed


def _parts_of(body: Body) -> LinkTable:
    from runtime.kinematics.kernels.link_poses import LinkTable

    tables = body.tables
    motions = tables.motions.reshape(-1, 4, 4, 4)
    drive = np.where(tables.coupling.any(axis=1), np.argmax(tables.coupling != 0, axis=1), -1)
    return LinkTable(
        motions=np.concatenate([motions[:, :, :3, :3].reshape(-1, 4, 9), motions[:, :, :3, 3]], axis=2),
        drive=drive.astype(np.int64),
        factor=tables.coupling[np.arange(len(drive)), np.maximum(drive, 0)],
        offset=tables.offsets.copy(),
        low=tables.low.copy(),
        high=tables.high.copy(),
        above=tables.above.astype(np.int64),
    )
