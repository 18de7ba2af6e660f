"""Visual appearance of a robot, for drawing; kinematics does not use it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robots import shapes
from robots.body import Body
from robots.robot import Robot
from robots.rotations import Float64
from robots.shapes import Colour

_THINNEST = 1e-4  # [m] least thickness of the box around a flat mesh


@dataclass(frozen=True, slots=True, eq=False)
class Visual:
    """Shape for drawing: box (x, y, z), cylinder (radius, length along z) or sphere (radius,), in m, or mesh.

    `part` is the index of its part, `origin` float64 [4, 4] the pose of its centre in that part, `colour` red, green,
    blue, opacity, 0 to 1. A mesh is the content of `file`, scaled by `size` (x, y, z).
    """

    part: int
    kind: str
    size: tuple[float, ...]
    origin: Float64
    colour: Colour
    file: Path | None = None

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the lower and upper corner [3] of the shape's box in its own frame [m], before `origin`."""
        return shapes.shape_bounds(self.kind, self.size, self.file)

    def simple(self) -> Visual:
        """Return the shape itself, or the bounding box of a mesh, for renderers that cannot draw meshes."""
        if self.kind != "mesh":
            return self
        lower, upper = self.bounds()
        place = np.eye(4)
        place[:3, 3] = (lower + upper) / 2
        size = tuple(np.maximum(upper - lower, _THINNEST).tolist())
        return replace(self, kind="box", size=size, origin=self.origin @ place, file=None)


class RobotScene(Body):
    """Body of a robot with the `visuals` of its parts."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.visuals = tuple(
            Visual(part, shape.kind, shape.size, shape.origin, shape.colour, shape.file)
            for shape in shapes.displayed_shapes(robot.urdf)
            for part in self.parts_showing(shape.link)
        )


def scene_of(robot: Robot) -> RobotScene:
    """Return the robot's parts and shapes.

    Raises:
        RobotError: If a shape cannot be drawn, or a mesh is missing.
    """
    return RobotScene(robot)
