"""Collision shapes and inertias of a robot for contact physics, in the frames of the parts that carry them.

Links have the capsules of the collision check. Hands have the shapes that are drawn, because a capsule around a palm
would reach between the fingers. All fingers are jaws that slide: see `jaw_solids`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robots import Body, shapes
from robots.capsules import capsules
from robots.inertials import Inertial, combine, read_inertials
from robots.shapes import Shape
from runtime.core.types import Float64
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.contact.physics import FINGER_SIZE

if TYPE_CHECKING:
    from robots import Group, Robot

_ACROSS = 1e-3  # [m] by which a shape of a closed finger may reach past the middle


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """Box (x, y, z), cylinder or capsule (radius, length along z between the caps), or sphere (radius,) in m.

    `origin` [4, 4] is the pose of its centre in the part that carries it.
    """

    kind: str
    size: tuple[float, ...]
    origin: Float64


class RobotSolids:
    """Collision shapes and inertias of a robot.

    `carrier` [P] is the index of the part with which each part of the robot's `body` is rigidly connected and which is
    nearest to the root; `moving` [P, D] tells which numbers of the robot's vector move a part.
    """

    def __init__(self, robot: Robot) -> None:
        self.body = Body(robot)
        self.moving = self.body.moving_mask()
        self.carrier = _carriers(self.body)
        self._robot = robot
        self._drawn = _by_link(robot)
        self._capsules = capsules(robot)
        self._inertials = read_inertials(robot.urdf)
        self._home: Float64 = self.body.poses(robot.poses["home"])

    def rigid_parts(self, part: int) -> list[int]:
        """Return the parts that are rigidly connected with `part`, including itself."""
        found: list[int] = np.flatnonzero(self.carrier == self.carrier[part]).tolist()
        return found

    def relative(self, part: int, carrier: int) -> Float64:
        """Return the constant pose [4, 4] of a part in another part that is rigidly connected with it."""
        return np.asarray(np.linalg.inv(self._home[carrier]) @ self._home[part])

    def link_solids(self, carrier: int) -> list[Solid]:
        """Return the capsules of all parts that are rigidly connected with `carrier`, in its frame."""
        found = []
        for part in self.rigid_parts(carrier):
            for capsule in self._capsules.get(self._link(part), ()):
                origin = self.relative(part, carrier) @ _along(capsule.start, capsule.end)
                length = float(np.linalg.norm(capsule.end - capsule.start))
                found.append(Solid("capsule", (capsule.radius, length), origin))
        return found

    def hand_solids(self, carrier: int) -> list[Solid]:
        """Return the drawn shapes of all parts that are rigidly connected with `carrier`, in its frame."""
        return [
            _solid(shape, self.relative(part, carrier))
            for part in self.rigid_parts(carrier)
            for shape in self._drawn.get(self._link(part), ())
        ]

    def inertial(self, carrier: int) -> Inertial | None:
        """Return the inertial of all parts that are rigidly connected with `carrier`, in its frame.

        None if the URDF declares none of them.
        """
        declared = [
            (self.relative(part, carrier), self._inertials[self._link(part)])
            for part in self.rigid_parts(carrier)
            if self._link(part) in self._inertials
        ]
        return combine(declared) if declared else None

    def jaw_solids(self, arm: Group) -> dict[int, list[Solid]]:
        """Return the shapes of the closed jaws in the frame of the fingertips, by side: -1 and 1, the sign of y.

        Jaws slide along y from there. This is exact for parallel grippers. The links of other grippers swing, and
        their pads come forward by up to 2 cm as they close; here the whole finger slides, as far apart as the
        description declares. Shapes of closed fingers that reach past the middle (racks, crossed links) are deep in
        the palm and are left out.
        """
        assert arm.gripper is not None
        assert arm.gripper_dim is not None
        q = self._robot.poses["home"].copy()
        q[arm.gripper_dim] = arm.gripper.close
        poses = self.body.poses(q)
        inverse = np.linalg.inv(arm_frames(self._robot)[arm.name].tip(q))
        found: dict[int, list[Solid]] = {-1: [], 1: []}
        for part in np.flatnonzero(self.moving[:, arm.gripper_dim]).tolist():
            placed = [_solid(shape, inverse @ poses[part]) for shape in self._drawn.get(self._link(part), ())]
            if not placed:
                continue
            side = 1 if sum(solid.origin[1, 3] for solid in placed) > 0 else -1
            found[side] += [solid for solid in placed if _least(solid, side) > -_ACROSS]
        return {side: solids or [_plain_finger(side)] for side, solids in found.items()}

    def _link(self, part: int) -> str:
        return self.body.parts[part].split("/", 1)[1]


def _carriers(body: Body) -> NDArray[np.intp]:
    driven = (body.tables.coupling != 0).any(axis=1)
    carrier = np.arange(len(body.parts))
    for part, above in enumerate(body.above):  # parents come first
        if above >= 0 and not driven[part]:
            carrier[part] = carrier[above]
    return carrier


def _by_link(robot: Robot) -> dict[str, list[Shape]]:
    found: dict[str, list[Shape]] = {}
    for shape in shapes.read_shapes(robot.urdf):
        found.setdefault(shape.link, []).append(shape)
    return found


def _solid(shape: Shape, carrier: Float64) -> Solid:
    """Return a drawn shape as a solid; `carrier` [4, 4] is the pose of its link. A mesh becomes its bounding box."""
    if shape.kind != "mesh":
        return Solid(shape.kind, shape.size, carrier @ shape.origin)
    lower, upper = shape.bounds()
    centre = np.eye(4)
    centre[:3, 3] = (lower + upper) / 2
    size = tuple(np.maximum(upper - lower, 1e-4).tolist())
    return Solid("box", size, carrier @ shape.origin @ centre)


def _least(solid: Solid, side: int) -> float:
    """Return the least distance of the box around a solid from the middle between the fingers [m], signed."""
    size = solid.size
    if solid.kind == "box":
        half = np.array(size) / 2
    else:
        half = np.array([size[0], size[0], size[1] / 2 if solid.kind == "cylinder" else size[0]])
    return float(side * solid.origin[1, 3] - np.abs(solid.origin[1, :3]) @ half)


def _plain_finger(side: int) -> Solid:
    origin = np.eye(4)
    origin[1, 3], origin[2, 3] = side * FINGER_SIZE[1] / 2, -FINGER_SIZE[2] / 2
    return Solid("box", FINGER_SIZE, origin)


def _along(start: Float64, end: Float64) -> Float64:
    """Return a frame [4, 4] in the middle between two points, with z from the first to the second."""
    frame = np.eye(4)
    frame[:3, 3] = (start + end) / 2
    length = float(np.linalg.norm(end - start))
    if length > 1e-9:
        z = (end - start) / length
        x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
        x /= np.linalg.norm(x)
        frame[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    return frame
