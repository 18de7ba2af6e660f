"""Occlusion order of convex solids: the order in which a painter has to draw them.

If a plane separates two convex solids, only the solid on the camera's side of the plane can hide the other. The planes
tried are the sides of the boxes around the solids; if the boxes of two solids overlap, as at a joint, the side that
separates them best decides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float32

Bool = NDArray[np.bool_]


class Order:
    """Drawing order of solids at their present poses.

    For each pair of solids, the side of a box that separates the two best is found once. `hides` then evaluates these
    sides for a viewpoint. Each solid is in a box with three unit axes, which are the rows of `axes` [S, 3, 3];
    `centres` and `halves` [S, 3] are the boxes' centres and half sizes.
    """

    def __init__(self, axes: Float32, centres: Float32, halves: Float32) -> None:
        count = len(halves)
        self._axes, self._centres = axes, centres
        self._halves = halves
        normals = axes.reshape(-1, 3)  # [3 S, 3]
        reach = np.abs(normals @ normals.T).reshape(-1, count, 3)  # length of every axis along every normal
        radius = (reach * halves).sum(-1).reshape(count, 3, count)
        along = (normals @ centres.T).reshape(count, 3, count)
        offset = along - along[np.arange(count), :, np.arange(count)][..., None]  # of the other centres
        gap = np.abs(offset) - halves[..., None] - radius  # [S, 3, S] between a side and the other box
        self._side = gap.argmax(1)  # [S, S]
        take = np.ogrid[:count, :count]
        self._gap = gap[take[0], self._side, take[1]]
        self._sign = offset[take[0], self._side, take[1]] > 0

    def hides(self, eye: Float32) -> Bool:
        """Return bool [S, S]: entry (i, j) is True if solid j can hide solid i as seen from `eye` [3]."""
        across = np.einsum("skd,sd->sk", self._axes, eye - self._centres)
        beyond = np.stack([-across > self._halves, across > self._halves], -1)  # [S, 3, 2]
        rows = np.arange(len(beyond))[:, None]
        mine: Bool = beyond[rows, self._side, self._sign.astype(np.intp)]
        better = self._gap >= self._gap.T
        return np.asarray(np.where(better, mine, ~mine.T))


def painted(hides: Bool, overlap: Bool, distance: Float32) -> list[int]:
    """Return the solids from back to front: a hidden solid before those that hide it, otherwise the farther one first.

    `hides` is as returned by `Order.hides`; `overlap` [S, S] is whether two solids overlap in the image. A cycle is
    broken at its farthest solid.
    """
    # A bit set per solid: the solids that it hides, which have to be drawn before it.
    below = np.packbits((hides & overlap).T, axis=1, bitorder="little")
    waits = [int.from_bytes(row.tobytes(), "little") & ~(1 << solid) for solid, row in enumerate(below)]
    queue = np.argsort(-distance, kind="stable").tolist()
    left = (1 << len(queue)) - 1
    order: list[int] = []
    while queue:
        solid = next((solid for solid in queue if not waits[solid] & left), queue[0])
        queue.remove(solid)
        left ^= 1 << solid
        order.append(solid)
    return order
