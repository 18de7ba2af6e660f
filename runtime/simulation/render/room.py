"""The room around the table, as far as a camera on an arm can see it: floor, ceiling, four walls."""

from __future__ import annotations

import cv2
import numpy as np

from runtime.core.types import Float32, UInt8
from runtime.simulation.bench.bench import PinholeCamera
from runtime.simulation.render.painter import fill_ahead

_FLOOR, _CEILING, _WALL = -0.75, 1.9, 2.4  # m from the table's surface; m from its middle


def _room() -> list[tuple[Float32, tuple[int, int, int]]]:
    """Floor and walls around the table as quads [4, 3] with their colours (blue, green, red)."""
    w, f, c, s = _WALL, _FLOOR, _CEILING, -0.05
    quads: list[tuple[list[tuple[float, float, float]], tuple[int, int, int]]] = [
        ([(-w, -w, f), (w, -w, f), (w, w, f), (-w, w, f)], (92, 88, 84)),
        ([(-w, -w, c), (w, -w, c), (w, w, c), (-w, w, c)], (226, 226, 224)),
    ]
    ends = [(-w, w), (w, w), (w, -w), (-w, -w)]
    for index, tone in enumerate((204, 190, 178, 194)):
        (a, b), (d, e) = ends[index], ends[(index + 1) % 4]
        quads.append(([(a, b, s), (d, e, s), (d, e, c), (a, b, c)], (tone, tone - 2, tone - 8)))
        low = int(tone * 0.72)
        quads.append(([(a, b, f), (d, e, f), (d, e, s), (a, b, s)], (low + 6, low, low - 8)))
    return [(np.array(corners, np.float32), colour) for corners, colour in quads]


_ROOM = _room()


def draw_room(picture: UInt8, camera: PinholeCamera) -> None:
    """Fill the picture with what of the room the camera sees."""
    eye, turn = camera.pose[:3, 3].astype(np.float32), camera.pose[:3, :3].astype(np.float32)
    picture.fill(118)  # of a seam that no wall covers
    for corners, colour in _ROOM:
        inside = np.asarray((corners - eye) @ turn, np.float32)
        fill_ahead(picture, camera, inside, colour, cv2.LINE_8)
