"""Texture of the table."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.core.types import UInt8
from runtime.simulation.bench.bench import Belt, Bench

X, Y = (-0.80, 0.80), (-0.42, 0.86)  # [m] edges of the table
TEXEL = 0.001  # [m] per point of the texture
_EDGE = 8  # points of the dark edge
_BOARD = 0.16  # [m] width of a board
_BEYOND = 0.08  # [m] of belt beyond the range of blocks, at either end
_RAIL, _RAIL_COLOUR = 0.008, (150, 154, 160)  # width [m], colour


def boards(bench: Bench, seed: int) -> NDArray[np.uint32]:
    """Return an image of the table from above, BGR [y, x] with TEXEL metres per point; `seed` decides the grain.

    It shows pale wooden boards along x, tape at the corners of the work area, and the belt if there is one.
    """
    chance = np.random.default_rng(seed)
    height, width = round((Y[1] - Y[0]) / TEXEL), round((X[1] - X[0]) / TEXEL)
    grain = _streaks(chance, height, width, 60, 0.0) * 3.5 + _streaks(chance, height, width, 260, 2.0) * 3.0
    grain += _streaks(chance, height, width, 700, 14.0) * 3.0
    board = (np.arange(height) * TEXEL / _BOARD).astype(int)
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
    for border in (texture[:_EDGE], texture[-_EDGE:], texture[:, :_EDGE], texture[:, -_EDGE:]):
        border[:] = 0.42 * np.array(bench.table_colour[::-1])
    return np.asarray(cv2.cvtColor(texture, cv2.COLOR_BGR2BGRA).view(np.uint32)[..., 0])


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
                (left, low), (right, high) = np.sort((ends / TEXEL).round().astype(int), axis=0).tolist()
                patch = texture[low:high, left:right]
                patch[:] = (patch * 0.25 + 0.75 * 236).astype(np.uint8)


def _roll_out(texture: UInt8, belt: Belt) -> None:
    """Draw a belt across the table with a rail on each side; it is longer than the range in which blocks ride."""
    ends = belt.x[0] - _BEYOND, belt.x[1] + _BEYOND
    for half, colour in ((belt.width / 2 + _RAIL, _RAIL_COLOUR), (belt.width / 2, belt.colour)):
        corners = np.column_stack([ends, (belt.y - half, belt.y + half)]) - (X[0], Y[0])
        (left, low), (right, high) = (corners / TEXEL).round().astype(int).tolist()
        patch = texture[low:high, left:right]
        patch[:] = np.clip(np.array(colour[::-1]) + (patch.astype(int) - 150) // 6, 0, 255)
