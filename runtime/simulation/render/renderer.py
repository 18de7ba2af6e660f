"""Renderer of all cameras at one moment: the robot at its joints, the bench in its present state."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from robots import scene_of
from runtime.core.types import Float64, UInt8
from runtime.kinematics import kernel_cache
from runtime.simulation.bench import bench as benches
from runtime.simulation.bench.bench import Bench, BenchState
from runtime.simulation.render import shadows, table
from runtime.simulation.render.rasteriser import PAINT, Ground, Matrix, Scratch, View, draw, make_scratch
from runtime.simulation.render.shadows import Shadows
from runtime.simulation.render.solids import Solid, Solids, disc_solid, shape_solid, table_solid

if TYPE_CHECKING:
    from robots import Robot


class Renderer:
    """Renderer of all cameras of a robot above a bench at [height, width]; `seed` decides the grain of the table.

    Images are deterministic to the last bit. Only fixed parts are cached between calls: geometry, the table's texture
    and the shadows of discs.
    """

    def __init__(self, robot: Robot, bench: Bench, width: int, height: int, seed: int = 0) -> None:
        self._robot = robot
        self._bench = bench
        self._size = width, height
        self._scene = scene_of(robot)
        self._texture = table.boards(bench, seed)
        self._shadows = Shadows(bench)
        self._solids: tuple[tuple[int, float, float], Solids, Scratch] | None = None  # for the last blocks
        empty = BenchState((), tuple((0.0, 0.0) for _ in bench.discs))
        kernel_cache.load(
            partial(self.draw, robot.poses["home"], empty)
        )  # no later call waits for a compiler

    def draw(self, q: Float64, state: BenchState) -> dict[str, UInt8]:
        """Return a newly allocated BGR uint8 [H, W, 3] image per camera key, for joints [D] and a bench state."""
        width, height = self._size
        solids, scratch = self._solids_of(len(state.blocks), state.size, state.hue)
        vertices, normals = solids.placed(np.concatenate([self._scene.poses(q), _bench_poses(state)]))
        light = self._shadows.cast(solids.geometry, vertices, normals, state.discs, scratch)
        ground = Ground(table.X[0], table.Y[0], 1 / table.TEXEL, 1 / shadows.TEXEL)
        pictures = {}
        for key, camera in benches.cameras(self._robot, q, width, height, state.camera_shift).items():
            lens = camera.lens @ camera.pose[:3, :3].T
            view = View(
                tuple(camera.pose[:3, 3].tolist()),
                _tuples(lens),
                _tuples(np.asarray(np.linalg.inv(lens))),
                float(state.light),
            )
            pictures[key] = np.empty((height, width, 3), np.uint8)
            draw(
                solids.geometry, vertices, normals, view, ground, self._texture, light, scratch, pictures[key]
            )
        return pictures

    def _solids_of(self, blocks: int, size: float, hue: float) -> tuple[Solids, Scratch]:
        """Return all solids, with `blocks` blocks of that size and hue, and buffers to draw them.

        The frames of the robot's parts precede those of `_bench_poses`.
        """
        appearance = (blocks, size, hue)
        if self._solids is None or self._solids[0] != appearance:
            bench, first = self._bench.varied(size, hue), len(self._scene.parts)
            visuals = (visual.simple() for visual in self._scene.visuals)
            solids = [
                table_solid(first, table.X, table.Y),
                *(shape_solid(v.part, v.kind, v.size, v.origin, v.colour) for v in visuals),
                *(_block(first + 1 + index, bench, index) for index in range(blocks)),
                *(disc_solid(first + 1 + blocks + index, disc) for index, disc in enumerate(bench.discs)),
            ]
            made = Solids(solids)
            self._solids = appearance, made, make_scratch(made.geometry, *self._size)
        return self._solids[1:]


def _bench_poses(state: BenchState) -> Float64:
    """Return the poses [n, 4, 4] of table, blocks and discs in the world."""
    poses = np.tile(np.eye(4), (1 + len(state.blocks) + len(state.discs), 1, 1))
    for pose, block in zip(poses[1:], state.blocks, strict=False):
        pose[:] = block.pose
    poses[1 + len(state.blocks) :, :2, 3] = state.discs
    return poses


def _block(frame: int, bench: Bench, index: int) -> Solid:
    red, green, blue = (part / 255 for part in bench.colour(index))
    return shape_solid(frame, "box", (bench.edge(index),) * 3, np.eye(4), (red, green, blue), PAINT)


def _tuples(matrix: Float64) -> Matrix:
    first, second, third = (tuple(row) for row in matrix.tolist())
    return first, second, third
