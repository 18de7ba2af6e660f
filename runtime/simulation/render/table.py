"""Renderer of the table and the room around it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float32, Float64, UInt8
from runtime.simulation.bench.bench import Belt, Bench, PinholeCamera
from runtime.simulation.render.painter import ahead, fill_ahead

_FLOOR, _CEILING, _WALL = -0.75, 1.9, 2.4  # [m] heights relative to the table; distance of walls


def _room() -> list[tuple[Float32, tuple[int, int, int]]]:
    """Return floor, ceiling and walls around the table as quadrilaterals [4, 3] with their colours (blue,
    green, red).
    """
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
    """Fill the image with the visible part of the room."""
    eye, turn = camera.pose[:3, 3].astype(np.float32), camera.pose[:3, :3].astype(np.float32)
    picture.fill(118)  # colour of gaps between the quads
    for corners, colour in _ROOM:
        inside = np.asarray((corners - eye) @ turn, np.float32)
        fill_ahead(picture, camera, inside, colour, cv2.LINE_8)


X, Y = (-0.80, 0.80), (-0.42, 0.86)  # [m] edges of the table
_TEXEL = 0.001  # [m] per point of the texture
_BOARD = 0.16  # [m] width of a board
_BEYOND = 0.08  # [m] of belt beyond the range of blocks, at either end
_RAIL, _RAIL_COLOUR = 0.008, (150, 154, 160)  # width [m], colour
CORNERS = np.array([[X[0], Y[0], 0.0], [X[1], Y[0], 0.0], [X[1], Y[1], 0.0], [X[0], Y[1], 0.0]])


class Table:
    """Table of pale wooden boards with a marked work area; `seed` decides the grain."""

    def __init__(self, bench: Bench, seed: int) -> None:
        self._bench = bench
        self._texture = _boards(bench, seed)

    def draw(self, camera: PinholeCamera) -> UInt8:
        """Return an image of the empty table in its room, BGR [H, W, 3]."""
        picture = np.empty((camera.height, camera.width, 3), np.uint8)
        outline = outline_of(camera)
        whole = covers(outline, camera)
        if not whole:
            draw_room(picture, camera)
        if len(outline) > 2:
            self._draw_boards(picture, camera, None if whole else outline)
        return picture

    def _draw_boards(self, picture: UInt8, camera: PinholeCamera, outline: Float32 | None) -> None:
        matrix = texels_to_pixels(camera, _TEXEL)
        size = (camera.width, camera.height)
        if outline is None:
            cv2.warpPerspective(self._texture, matrix, size, picture, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)
            return
        top = int(np.clip(outline[:, 1].min(), 0, camera.height))
        rows = picture[top : int(np.clip(outline[:, 1].max() + 2, top, camera.height))]
        if len(rows) == 0:
            return
        matrix[:2] -= np.outer((0, top), matrix[2])
        size = (camera.width, len(rows))
        boards = cv2.warpPerspective(
            self._texture, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        corners = ((outline - np.array([0, top], np.float32)) * 16).round().astype(np.int32)
        mask = np.zeros(rows.shape[:2], np.uint8)
        cv2.fillConvexPoly(mask, corners, 255, cv2.LINE_8, 4)
        cv2.copyTo(boards, mask, rows)
        edge = [part * 0.42 for part in self._bench.table_colour[::-1]]
        cv2.polylines(rows, [corners], True, edge, 2, cv2.LINE_AA, 4)


def texels_to_pixels(camera: PinholeCamera, texel: float) -> Float64:
    """Return the homography [3, 3] from a map of the table with `texel` [m] per point to the camera's image."""
    to_world = np.array([[texel, 0, X[0]], [0, texel, Y[0]], [0, 0, 0], [0, 0, 1.0]])
    lens = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    turn = camera.pose[:3, :3].T
    return np.asarray(lens @ np.column_stack([turn, -turn @ camera.pose[:3, 3]]) @ to_world)


def outline_of(camera: PinholeCamera) -> Float32:
    """Return the outline, in pixels [n, 2], of the part of the table in front of the camera; empty if there is none."""
    inside = ahead(((CORNERS - camera.pose[:3, 3]) @ camera.pose[:3, :3]).astype(np.float32))
    if len(inside) < 3:
        return np.empty((0, 2), np.float32)
    pixels = inside[:, :2] / inside[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return np.asarray(np.clip(pixels, -12000, 12000), np.float32)


def covers(outline: Float32, camera: PinholeCamera) -> bool:
    """Return True if all corners of the image are inside the outline."""
    if len(outline) < 3:
        return False
    right, low = float(camera.width), float(camera.height)
    corners = ((-1.0, -1.0), (right, -1.0), (right, low), (-1.0, low))
    return all(cv2.pointPolygonTest(outline, corner, False) > 0 for corner in corners)


def _boards(bench: Bench, seed: int) -> UInt8:
    """Draw boards along x with grain, joints between them, and tape at the corners of the work area."""
    chance = np.random.default_rng(seed)
    height, width = round((Y[1] - Y[0]) / _TEXEL), round((X[1] - X[0]) / _TEXEL)
    grain = _streaks(chance, height, width, 60, 0.0) * 3.5 + _streaks(chance, height, width, 260, 2.0) * 3.0
    grain += _streaks(chance, height, width, 700, 14.0) * 3.0
    board = (np.arange(height) * _TEXEL / _BOARD).astype(int)
    tone = chance.uniform(-5.0, 5.0, board[-1] + 1)[board][:, None]
    wood = np.array(bench.table_colour[::-1], np.float32) + (grain + tone)[..., None].astype(np.float32)
    joints = np.flatnonzero(np.diff(board))
    for row in joints.tolist():
        wood[row : row + 2] *= 0.80
        wood[row + 2 : row + 3] *= 1.05
    texture: UInt8 = np.clip(wood, 0, 255).astype(np.uint8)
    _tape(texture, bench)
    if bench.belt is not None:
        _roll_out(texture, bench.belt)
    return texture


def _streaks(
    chance: np.random.Generator, height: int, width: int, along: int, across: float
) -> NDArray[np.float32]:
    """Return noise with standard deviation 1, blurred over `along` texels in x and, unless 0, `across` texels in y."""
    noise = chance.standard_normal((height, width // 4)).astype(np.float32)
    smeared = cv2.GaussianBlur(noise, (0, 0), along / 16, sigmaY=across or 0.3)
    wide = cv2.resize(smeared, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide / wide.std(), np.float32)


def _tape(texture: UInt8, bench: Bench) -> None:
    """Draw a white angle slightly outside each corner of the work area."""
    x_from, x_to, y_from, y_to = bench.area
    margin, arm, thick = 0.045, 0.045, 0.005
    for x, inwards_x in ((x_from - margin, 1), (x_to + margin, -1)):
        for y, inwards_y in ((y_from - margin, 1), (y_to + margin, -1)):
            for size in ((arm * inwards_x, thick * inwards_y), (thick * inwards_x, arm * inwards_y)):
                ends = np.array([[x, y], [x + size[0], y + size[1]]]) - (X[0], Y[0])
                (left, low), (right, high) = np.sort((ends / _TEXEL).round().astype(int), axis=0).tolist()
                patch = texture[low:high, left:right]
                patch[:] = (patch * 0.25 + 0.75 * 236).astype(np.uint8)


def _roll_out(texture: UInt8, belt: Belt) -> None:
    """Draw a belt across the table with a rail on each side; it is longer than the range in which blocks ride."""
    ends = belt.x[0] - _BEYOND, belt.x[1] + _BEYOND
    for half, colour in ((belt.width / 2 + _RAIL, _RAIL_COLOUR), (belt.width / 2, belt.colour)):
        corners = np.column_stack([ends, (belt.y - half, belt.y + half)]) - (X[0], Y[0])
        (left, low), (right, high) = (corners / _TEXEL).round().astype(int).tolist()
        patch = texture[low:high, left:right]
        patch[:] = np.clip(np.array(colour[::-1]) + (patch.astype(int) - 150) // 6, 0, 255)
