"""Shadows on the table, cast by everything on it or above it."""

from __future__ import annotations

import cv2
import numpy as np

from runtime.core.types import Float64, UInt8
from runtime.simulation.bench.bench import Bench
from runtime.simulation.render.rasteriser import LIGHT, Geometry, Scratch, cast
from runtime.simulation.render.table import X, Y

Places = tuple[tuple[float, float], ...]

TEXEL = 0.004  # [m] per point of the map


class Shadows:
    """Map of the light on the table as seen from above, uint8 [y, x] with TEXEL metres per point (255 = full light)."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._shape = round((Y[1] - Y[0]) / TEXEL), round((X[1] - X[0]) / TEXEL)
        self._under_discs: tuple[Places, UInt8] | None = None

    def cast(
        self, geometry: Geometry, vertices: Float64, normals: Float64, places: Places, scratch: Scratch
    ) -> UInt8:
        """Return the map for solids in the world (vertices [V, 3], normals [F, 3]) and discs at `places` (x, y) [m].

        Shadows are dark and sharp below low solids, light and soft below high solids.
        """
        sizes = [(disc.radius, disc.height) for disc in self._bench.discs]
        discs = np.array([(*place, *size) for place, size in zip(places, sizes, strict=True)], np.float64)
        soft, sharp = np.full((2, *self._shape), 255, np.uint8)
        corner = (X[0], Y[0], TEXEL)
        cast(geometry, vertices, normals, discs.reshape(-1, 4), corner, scratch, soft, sharp)
        blurred = cv2.min(
            cv2.blur(cv2.blur(soft, (13, 13)), (9, 9)), cv2.blur(cv2.blur(sharp, (5, 5)), (3, 3))
        )
        return np.asarray(cv2.min(blurred, self._disc_map(places)), np.uint8)

    def _disc_map(self, places: Places) -> UInt8:
        """Return the map that contains only the shadows of discs.

        The shadow falls on the table around a disc, and not on the disc itself.
        """
        if self._under_discs is None or self._under_discs[0] != places:
            shade = np.full(self._shape, 255, np.uint8)
            placed = list(zip(self._bench.discs, map(np.array, places), strict=True))
            for disc, place in placed:
                self._disc(
                    shade, place - disc.height * np.array(LIGHT[:2]) / LIGHT[2], disc.radius * 1.02, 120
                )
            shade = np.asarray(cv2.blur(cv2.blur(shade, (5, 5)), (5, 5)), np.uint8)
            for disc, place in placed:
                self._disc(shade, place, disc.radius * 0.99, 255)
            self._under_discs = places, shade
        return self._under_discs[1]

    @staticmethod
    def _disc(shade: UInt8, centre: Float64, radius: float, light: int) -> None:
        column, row = ((centre - (X[0], Y[0])) / TEXEL * 16).round().astype(int).tolist()
        cv2.circle(shade, (column, row), round(radius / TEXEL * 16), light, cv2.FILLED, cv2.LINE_AA, 4)
