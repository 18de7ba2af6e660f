"""The bench's overhead picture as plain polygons: what perception is tested on without the renderer."""

from __future__ import annotations

import math

import cv2
import numpy as np

from runtime.simulation.bench import bench
from runtime.simulation.bench.bench import Bench, BenchLayout

BENCH = Bench()
CAMERA = bench.overhead_camera(640, 480)
_FINER = 4
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
_SHADES = (1.0, 0.55, 0.7, 0.75, 0.8, 0.6)  # top, bottom, sides


def drawn(layout: BenchLayout, z: float = 0.0, light: float = 1.0) -> np.ndarray:
    """RGB uint8 [480, 640, 3]: the plate, and the first block lying at height z."""
    shape = (CAMERA.height * _FINER, CAMERA.width * _FINER, 3)
    canvas = np.tile(np.uint8(np.multiply(BENCH.table_colour, light)), (*shape[:2], 1))
    for radius, colour in (
        (BENCH.discs[0].radius, BENCH.discs[0].rim_colour),
        (BENCH.discs[0].radius - 0.012, BENCH.discs[0].colour),
    ):
        turns = np.linspace(0, 2 * math.pi, 90)
        x, y = layout.discs[0]
        ring = np.column_stack(
            [x + radius * np.cos(turns), y + radius * np.sin(turns), np.full(90, BENCH.discs[0].height)]
        )
        _fill(canvas, ring, np.multiply(colour, light))
    if layout.blocks:
        _block(canvas, layout.blocks[0], z, light)
    return cv2.resize(canvas, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)


def _block(canvas: np.ndarray, block: tuple[float, float, float], z: float, light: float) -> None:
    pose = bench.block_pose(block, BENCH.block_edge)
    half = BENCH.block_edge / 2
    signs = np.array([(x, y, up) for up in (1, -1) for x in (-1, 1) for y in (-1, 1)])
    corners = signs * half @ pose[:3, :3].T + pose[:3, 3] + (0, 0, z)
    eye = CAMERA.pose[:3, 3]
    faces = [(corners[list(face)], shade) for face, shade in zip(_FACES, _SHADES, strict=True)]
    for face, shade in sorted(faces, key=lambda item: -np.linalg.norm(item[0].mean(axis=0) - eye)):
        _fill(canvas, face, np.multiply(BENCH.colour(0), shade * light))


def _fill(canvas: np.ndarray, points: np.ndarray, colour: np.ndarray) -> None:
    pixels = (CAMERA.project(points) + 0.5) * _FINER - 0.5
    cv2.fillPoly(canvas, [np.round(pixels).astype(np.int32)], [int(part) for part in colour])
