"""What a robot looks like, for drawing; kinematics never uses it."""

from __future__ import annotations

from dataclasses import dataclass

from robots import shapes
from robots.body import Body
from robots.robot import Robot
from robots.rotations import Float64
from robots.shapes import Colour


@dataclass(frozen=True, slots=True, eq=False)
class Visual:
    """One shape: `kind` box (x, y, z), cylinder (radius, length along z) or sphere (radius,), in m.

    `part` is the index of the part that carries it, `origin` float64 [4, 4] its centre in that part, `colour`
    red, green, blue, opacity, 0 to 1.
    """

    part: int
    kind: str
    size: tuple[float, ...]
    origin: Float64
    colour: Colour


class RobotScene(Body):
    """A robot's body with the `visuals` that its parts carry."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.visuals = tuple(
            Visual(part, shape.kind, shape.size, shape.origin, shape.colour)
            for shape in shapes.read(robot.urdf)
            for part in self.parts_of(shape.link)
        )


def scene_of(robot: Robot) -> RobotScene:
    """The robot's parts and shapes; RobotError where its URDF shows what is no box, cylinder or sphere."""
    return RobotScene(robot)
