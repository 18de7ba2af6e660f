"""Looks of a robot, for drawing; kinematics never uses them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robots import shapes
from robots.body import Body
from robots.robot import Robot
from robots.rotations import Float64
from robots.shapes import Colour

_THINNEST = 1e-4  # m, of a box around a mesh that is flat


@dataclass(frozen=True, slots=True, eq=False)
class Visual:
    """One shape: `kind` box (x, y, z), cylinder (radius, length along z) or sphere (radius,), in m, or a mesh.

    `part` is the index of the part that carries it, `origin` float64 [4, 4] its centre in that part, `colour`
    red, green, blue, opacity, 0 to 1. A mesh is what `file` shows, stretched by `size` (x, y, z).
    """

    part: int
    kind: str
    size: tuple[float, ...]
    origin: Float64
    colour: Colour
    file: Path | None = None

    def bounds(self) -> tuple[Float64, Float64]:
        """The least and the greatest corner [3] of the shape's box in its own frame [m], before `origin`."""
        return shapes.shape_bounds(self.kind, self.size, self.file)

    def simple(self) -> Visual:
        """The same for those who can draw no mesh: the box around it."""
        if self.kind != "mesh":
            return self
        lower, upper = self.bounds()
        place = np.eye(4)
        place[:3, 3] = (lower + upper) / 2
        size = tuple(np.maximum(upper - lower, _THINNEST).tolist())
        return replace(self, kind="box", size=size, origin=self.origin @ place, file=None)


class RobotScene(Body):
    """A robot's body with the `visuals` that its parts carry."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.visuals = tuple(
            Visual(part, shape.kind, shape.size, shape.origin, shape.colour, shape.file)
            for shape in shapes.displayed_shapes(robot.urdf)
            for part in self.parts_showing(shape.link)
        )


def scene_of(robot: Robot) -> RobotScene:
    """The robot's parts and shapes; RobotError where its URDF shows what cannot be drawn, or a mesh is missing."""
    return RobotScene(robot)
