"""Renderer of the round plate on the table: outer side, coloured rim, inward slope and flat middle."""

from __future__ import annotations

import cv2
import numpy as np

from runtime.core.types import Float32, UInt8
from runtime.simulation.bench.bench import DiscShape, PinholeCamera
from runtime.simulation.render.painter import fill_ahead
from runtime.simulation.render.solids import circle

_POINTS = 64  # per ring
_NEAR = 0.02  # [m] in front of the camera
_INSIDE = (  # share of the radius, share of the height, brightness; from the rim inwards
    (0.93, 0.95, 0.97),
    (0.90, 0.90, 0.86),
    (0.72, 0.35, 0.93),
    (0.70, 0.33, 1.00),
)


class Plate:
    """Plate as concentric rings, each of which is drawn over the previous ones."""

    def __init__(self, disc: DiscShape) -> None:
        radius, height = disc.radius, disc.height
        rim = np.array(disc.rim_colour[::-1], np.float64)
        white = np.array(disc.colour[::-1], np.float64)
        levels = [(0.92, 0.0), (1.0, 1.0), *((share, level) for share, level, _ in _INSIDE)]
        self._rings = np.array(
            [
                np.column_stack([circle(radius * share, _POINTS), np.full(_POINTS, height * level)])
                for share, level in levels
            ]
        ).reshape(-1, 3)
        self._side = (rim * 0.55).tolist()
        self._colours = [rim.tolist(), *((white * tone).tolist() for _, _, tone in _INSIDE)]

    def draw(self, picture: UInt8, camera: PinholeCamera, place: tuple[float, float]) -> None:
        """Draw the plate onto the image, with its middle at `place` (x, y) [m]."""
        eye = camera.pose[:3, 3] - (*place, 0.0)
        inside = np.asarray((self._rings - eye) @ camera.pose[:3, :3], np.float32)
        if inside[:, 2].max() < _NEAR:
            return
        if inside[:, 2].min() < _NEAR:
            rings = inside.reshape(-1, _POINTS, 3)[1:]
            for ring, colour in zip(rings, self._colours, strict=True):
                fill_ahead(picture, camera, ring, colour)
            return
        pixels = inside[:, :2] / inside[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        if (pixels.max(0) < 0).any() or (pixels.min(0) > (camera.width, camera.height)).any():
            return
        self._fill(picture, np.asarray(np.clip(pixels, -9000, 9000), np.float32))

    def _fill(self, picture: UInt8, pixels: Float32) -> None:
        rings = (pixels * 16).round().astype(np.int32).reshape(-1, _POINTS, 2)
        side = cv2.convexHull(rings[:2].reshape(-1, 2))
        cv2.fillConvexPoly(picture, side, self._side, cv2.LINE_AA, 4)
        for ring, colour in zip(rings[1:], self._colours, strict=True):
            cv2.fillConvexPoly(picture, ring, colour, cv2.LINE_AA, 4)
