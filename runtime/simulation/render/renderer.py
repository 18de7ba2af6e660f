"""Renderer of all cameras at one moment: the robot at its joints, the bench in its present state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from robots import scene_of
from runtime.core.types import Float64, UInt8
from runtime.simulation.bench import bench as benches
from runtime.simulation.bench.bench import Bench, BenchState, PinholeCamera
from runtime.simulation.render.painter import Painter
from runtime.simulation.render.plate import Plate
from runtime.simulation.render.shadows import Shadows, darken
from runtime.simulation.render.solids import Solid, Solids
from runtime.simulation.render.table import Table

if TYPE_CHECKING:
    from robots import Robot


class Renderer:
    """Renderer of all cameras of a robot above a bench at [height, width]; `seed` decides the grain of the table.

    Images are deterministic to the last bit. Only fixed parts are cached between calls: geometry, the table's texture
    and the background of overhead cameras.
    """

    def __init__(self, robot: Robot, bench: Bench, width: int, height: int, seed: int = 0) -> None:
        self._robot = robot
        self._bench = bench
        self._size = width, height
        self._scene = scene_of(robot)
        self._table = Table(bench, seed)
        self._plates = [Plate(disc) for disc in bench.discs]
        self._shadows = Shadows(bench)
        self._solids: tuple[tuple[int, float, float], Solids] | None = (
            None  # number, size and hue of the last blocks
        )
        q = robot.poses["home"]
        carriers = {camera.key: benches.camera_arm(robot, camera) for camera in robot.cameras}
        still = {key for key, arm in carriers.items() if arm is None}
        self._still = {
            key: self._table.draw(camera) for key, camera in self._cameras(q).items() if key in still
        }

    def draw(self, q: Float64, state: BenchState) -> dict[str, UInt8]:
        """Return a newly allocated BGR uint8 [H, W, 3] image per camera key, for joints [D] and a bench state."""
        solids = self._solids_of(len(state.blocks), state.size, state.hue)
        frames = np.array([*self._scene.poses(q), *(block.pose for block in state.blocks)])
        whole = solids.placed(frames)
        placed = solids.above_table(whole)
        light = self._shadows.cast(solids, placed, state.discs)
        painter = Painter(solids, placed)
        pictures = {}
        usual = not any(state.camera_shift)
        for key, camera in self._cameras(q, state.camera_shift).items():
            still = self._still.get(key) if usual else None
            picture = self._table.draw(camera) if still is None else still.copy()
            for plate, place in zip(self._plates, state.discs, strict=True):
                plate.draw(picture, camera, place)
            darken(picture, camera, light)
            under = camera.pose[2, 3] < 0  # camera below the table: a simulated arm can go there
            (Painter(solids, whole) if under else painter).paint(picture, camera)
            if state.light != 1.0:
                cv2.convertScaleAbs(picture, picture, alpha=state.light)
            pictures[key] = picture
        return pictures

    def _cameras(
        self, q: Float64, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> dict[str, PinholeCamera]:
        return benches.cameras(self._robot, q, *self._size, shift)

    def _solids_of(self, blocks: int, size: float, hue: float) -> Solids:
        """Return the solids for the robot's visual shapes and for `blocks` blocks of that size and hue.

        The frames of blocks follow the frames of the robot's parts.
        """
        appearance = (blocks, size, hue)
        if self._solids is None or self._solids[0] != appearance:
            shapes = [
                Solid(visual.part, visual.kind, visual.size, visual.origin, visual.colour[:3])
                for visual in (scene_visual.simple() for scene_visual in self._scene.visuals)
            ]
            bench = self._bench.varied(size, hue)
            self._solids = (
                appearance,
                Solids([*shapes, *(self._block(bench, index) for index in range(blocks))]),
            )
        return self._solids[1]

    def _block(self, bench: Bench, index: int) -> Solid:
        red, green, blue = (part / 255 for part in bench.colour(index))
        edge = bench.edge(index)
        frame = len(self._scene.parts) + index
        return Solid(frame, "box", (edge, edge, edge), np.eye(4), (red, green, blue), painted=True)
