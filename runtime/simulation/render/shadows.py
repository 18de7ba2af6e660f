"""Shadows on the table, cast by everything on it or above it."""

from __future__ import annotations

import cv2
import numpy as np

from runtime.core.types import Float64, UInt8
from runtime.simulation.bench.bench import Bench, PinholeCamera
from runtime.simulation.render.painter import LIGHT
from runtime.simulation.render.solids import Placed, Solids
from runtime.simulation.render.table import (
    X,
    Y,
    covers,
    outline_of,
    texels_to_pixels,
)

Places = tuple[tuple[float, float], ...]

_TEXEL = 0.004  # [m] per point of the map
_SOFT_FROM = 0.09  # [m] height above the table from which shadows are soft


class Shadows:
    """Map of the light on the table as seen from above, uint8 (255 = full light)."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        size = ((Y[1] - Y[0]) / _TEXEL, (X[1] - X[0]) / _TEXEL)
        self._shape = (round(size[0]), round(size[1]))
        self._under_discs: tuple[Places, UInt8] | None = None

    def cast(self, solids: Solids, placed: Placed, discs: Places) -> UInt8:
        """Return the map of the light for solids, and for discs at their places (x, y) [m].

        Shadows are dark and sharp below low solids, light and soft below high solids.
        """
        vertices = placed.vertices
        floor = np.zeros(len(placed.centres), np.float32)
        for disc, place in zip(self._bench.discs, discs, strict=True):
            over = np.hypot(*(placed.centres[:, :2] - np.array(place)).T) < disc.radius * 0.9
            floor[over] = disc.height * 0.4
        counts = solids.stops - solids.starts
        height = np.maximum(vertices[:, 2:] - np.repeat(floor, counts)[:, None], 0)
        points = vertices[:, :2] - height * (LIGHT[:2] / LIGHT[2])
        corners = ((points - (X[0], Y[0])) / _TEXEL * 16).astype(np.int32)
        middle = placed.centres[:, 2]
        soft, sharp = np.full((2, *self._shape), 255, np.uint8)
        for solid in filter(placed.seen.__getitem__, np.argsort(-middle).tolist()):
            hull = cv2.convexHull(corners[solids.starts[solid] : solids.stops[solid]])
            high = middle[solid] > _SOFT_FROM
            light = 150 + 60 * min(1.0, float(middle[solid]) / 0.4) if high else 118
            cv2.fillConvexPoly(soft if high else sharp, hull, light, cv2.LINE_8, 4)
        blurred = cv2.min(
            cv2.blur(cv2.blur(soft, (13, 13)), (9, 9)), cv2.blur(cv2.blur(sharp, (5, 5)), (3, 3))
        )
        return np.asarray(cv2.min(blurred, self._disc_map(discs)), np.uint8)

    def _disc_map(self, discs: Places) -> UInt8:
        """Return the map that contains only the shadows of discs.

        The shadow falls on the table around a disc, and not on the disc itself.
        """
        if self._under_discs is None or self._under_discs[0] != discs:
            shade = np.full(self._shape, 255, np.uint8)
            placed = list(zip(self._bench.discs, map(np.array, discs), strict=True))
            for disc, place in placed:
                self._disc(shade, place - disc.height * LIGHT[:2] / LIGHT[2], disc.radius * 1.02, 120)
            shade = np.asarray(cv2.blur(cv2.blur(shade, (5, 5)), (5, 5)), np.uint8)
            for disc, place in placed:
                self._disc(shade, place, disc.radius * 0.99, 255)
            self._under_discs = discs, shade
        return self._under_discs[1]

    @staticmethod
    def _disc(shade: UInt8, centre: Float64, radius: float, light: int) -> None:
        column, row = ((centre - (X[0], Y[0])) / _TEXEL * 16).round().astype(int).tolist()
        cv2.circle(shade, (column, row), round(radius / _TEXEL * 16), light, cv2.FILLED, cv2.LINE_AA, 4)


def darken(picture: UInt8, camera: PinholeCamera, light: UInt8) -> None:
    """Darken the table in an image by the map `light`."""
    half = (camera.width // 2, camera.height // 2)
    matrix = np.diag([0.5, 0.5, 1.0]) @ texels_to_pixels(camera, _TEXEL)
    small = cv2.warpPerspective(
        light, matrix, half, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255
    )
    outline = outline_of(camera)
    if not covers(outline, camera):  # above the horizon a homography also maps points behind the camera
        mask = np.full(small.shape, 255, np.uint8)
        if len(outline) > 2:
            cv2.fillConvexPoly(mask, (outline * 8).round().astype(np.int32), 0, cv2.LINE_8, 4)
        small = cv2.max(small, mask)
    full = cv2.resize(small, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
    cv2.multiply(picture, cv2.cvtColor(full, cv2.COLOR_GRAY2BGR), dst=picture, scale=1 / 255)
