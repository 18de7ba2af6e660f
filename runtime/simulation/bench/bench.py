"""The simulated bench: what lies on its table and where, and where its cameras are; no robot, no physics.

World frame: the robot's scene, z up, the table's surface at z = 0; metres, radians. Robots stand at its near side,
where y is below that of the area.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.errors import RuntimeFault
from runtime.core.types import Float64
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.wrist_camera import CameraPlacement, place_wrist_camera

if TYPE_CHECKING:
    from robots import Camera, Group, Robot

Colour = tuple[int, int, int]

_OVERHEAD_EYE, _OVERHEAD_AIM = (0.0, 0.36, 0.85), (0.0, 0.27, 0.0)
_OVERHEAD_FOCAL = 1.0  # per picture width
_WRIST_FOCAL = 0.75


class BenchError(RuntimeFault):
    """A layout was asked for that the bench cannot have."""


@dataclass(frozen=True, slots=True)
class Belt:
    """A belt along x: where it lies, and where beside a block that rides on it fingertips are to be [m].

    The block's centre rides between both ends of `x` at `y`. `beside` is from the block's foot to the place of
    the fingertips: nearer to the arms, so that no arm hides the block from the camera above, and clear of it.
    """

    x: tuple[float, float] = (-0.10, 0.30)
    y: float = 0.34
    width: float = 0.08
    fingertip_offset: tuple[float, float, float] = (0.0, -0.07, 0.08)
    colour: Colour = (70, 74, 80)


@dataclass(frozen=True, slots=True)
class Bench:
    """Sizes [m] and colours (red, green, blue; 0 to 255) of everything on the table.

    `area` is where things may lie: x from, x to, y from, y to. The first block, the task's, has the first of
    `block_colours`, the others the next ones in turn.
    """

    block_edge: float = 0.04
    plate_radius: float = 0.075
    plate_height: float = 0.012
    area: tuple[float, float, float, float] = (-0.22, 0.22, 0.18, 0.40)
    table_colour: Colour = (176, 164, 146)
    plate_colour: Colour = (226, 234, 244)
    plate_rim_colour: Colour = (58, 104, 190)
    block_colours: tuple[Colour, ...] = ((226, 74, 22), (40, 150, 70), (150, 70, 170), (235, 190, 40))
    belt: Belt | None = None


@dataclass(frozen=True, slots=True)
class BenchLayout:
    """Places of blocks (x, y, yaw) and plate (x, y) after a reset; the first block is the task's."""

    blocks: tuple[tuple[float, float, float], ...]
    plate: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class BlockState:
    """A block's centre and axes in the world, `pose` [4, 4], and the name of the arm that holds it, or ""."""

    pose: Float64
    held_by: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class BenchState:
    """Everything on the table that can move, at one instant."""

    blocks: tuple[BlockState, ...]
    plate: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class PinholeCamera:
    """A camera without distortion; `pose` [4, 4] is its frame in the world: z ahead, x right, y down.

    Pixels are (u, v), columns and rows; whole numbers are the centres of pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    pose: Float64

    def project(self, points: Float64) -> Float64:
        """Pixels [..., 2] of world points [..., 3]; NaN for those not in front of the camera."""
        inside = (np.asarray(points, np.float64) - self.pose[:3, 3]) @ self.pose[:3, :3]
        depth = np.where(inside[..., 2:] > 1e-6, inside[..., 2:], np.nan)
        return np.asarray(inside[..., :2] / depth * (self.fx, self.fy) + (self.cx, self.cy))

    def pixel_to_table(self, u: float, v: float, z: float = 0.0) -> tuple[float, float]:
        """World x, y of what a pixel shows at height `z`; BenchError where its ray never gets there."""
        ray = self.pose[:3, :3] @ [(u - self.cx) / self.fx, (v - self.cy) / self.fy, 1.0]
        way = (z - self.pose[2, 3]) / ray[2] if abs(ray[2]) > 1e-9 else -1.0
        if way <= 0:
            raise BenchError(f"pixel ({u}, {v}) shows nothing at height {z} m")
        x, y, _ = self.pose[:3, 3] + way * ray
        return float(x), float(y)


def block_pose(block: tuple[float, float, float], bench: Bench) -> Float64:
    """The pose [4, 4] of a block that lies flat on the table at (x, y, yaw)."""
    x, y, yaw = block
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    pose[:3, 3] = x, y, bench.block_edge / 2
    return pose


def yaw_of(pose: Float64) -> float:
    """The turn about z of a pose [4, 4], or of its y axis where x points up or down."""
    if math.hypot(pose[0, 0], pose[1, 0]) > 0.1:
        return math.atan2(pose[1, 0], pose[0, 0])
    return math.atan2(-pose[0, 1], pose[1, 1])


def tip_in_world(robot: Robot, arm: Group, q: Float64) -> Float64:
    """An arm's fingertips in the world, [4, 4], at the robot's joints q [D]: z ahead, y the way they open."""
    return arm_frames(robot)[arm.name].tip(q)


def camera_arm(robot: Robot, camera: Camera) -> Group | None:
    """The arm that carries a camera; None for one that looks from above, which all others do.

    The arm's name without "_arm" begins the camera's, or the camera is called after a wrist and there is one arm.
    """
    for arm in robot.arms:
        if camera.name.startswith(arm.name.removesuffix("_arm")):
            return arm
    return robot.arms[0] if "wrist" in camera.name and len(robot.arms) == 1 else None


def cameras(robot: Robot, q: Float64, width: int, height: int) -> dict[str, PinholeCamera]:
    """All cameras of the robot by key, where they are at joints q [D]; what is on no arm looks from above."""
    carriers = {camera.key: camera_arm(robot, camera) for camera in robot.cameras}
    return {
        key: overhead_camera(width, height)
        if arm is None
        else wrist_camera(tip_in_world(robot, arm, q), width, height, place_wrist_camera(robot, arm.name))
        for key, arm in carriers.items()
    }


def overhead_camera(width: int, height: int) -> PinholeCamera:
    """The camera above the bench: the arms reach into its picture from below."""
    pose = _looking(_OVERHEAD_EYE, _OVERHEAD_AIM, up=(0.0, 1.0, 0.0))
    return _camera(pose, _OVERHEAD_FOCAL, width, height)


def wrist_camera(tip: Float64, width: int, height: int, eye: CameraPlacement | None = None) -> PinholeCamera:
    """The camera beside the fingers of an arm whose fingertips are at `tip` [4, 4]."""
    eye = eye or CameraPlacement()
    return _camera(tip @ _looking(eye.place, eye.aim, eye.up), _WRIST_FOCAL, width, height)


def _camera(pose: Float64, focal: float, width: int, height: int) -> PinholeCamera:
    return PinholeCamera(focal * width, focal * width, (width - 1) / 2, (height - 1) / 2, width, height, pose)


def _looking(eye: tuple[float, ...], aim: tuple[float, ...], up: tuple[float, ...]) -> Float64:
    """A camera frame [4, 4] at `eye` that looks at `aim`, with `up` towards the top of its picture."""
    ahead = np.subtract(aim, eye) / math.dist(aim, eye)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = eye
    return pose
