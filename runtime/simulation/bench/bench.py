"""Objects of the simulated bench with their sizes and places, and its cameras; without robot and physics.

World frame: the robot's scene, z up, the table's surface at z = 0; metres, radians. Robots are at the near side of the
table, where y is less than in the area for objects.
"""

from __future__ import annotations

import colorsys
import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from runtime.benches.schema import BenchSchema, Disc, load_schema
from runtime.core.errors import RuntimeFault
from runtime.core.types import Float64
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.wrist_camera import CameraPlacement, place_wrist_camera

if TYPE_CHECKING:
    from robots import Camera, Group, Robot

Colour = tuple[int, int, int]

TABLETOP = load_schema("tabletop")
_OVERHEAD_EYE, _OVERHEAD_AIM = (0.0, 0.36, 0.85), (0.0, 0.27, 0.0)
_OVERHEAD_FOCAL = 1.0  # focal length in image widths
_WRIST_FOCAL = 0.75


def _colour(parts: Sequence[int]) -> Colour:
    red, green, blue = parts
    return red, green, blue


class BenchError(RuntimeFault):
    """Error that a requested layout is not possible on the bench."""


@dataclass(frozen=True, slots=True)
class Belt:
    """Belt along x: its place, and the place of the fingertips relative to a block that rides on it [m].

    The centre of the block rides between the two ends of `x`, at `y`. `fingertip_offset` leads from the centre of the
    block's bottom face to the place of the fingertips. This place is nearer to the arms than the block, so that no arm
    hides the block from the overhead camera, and it is so far away that the fingertips do not touch the block.
    """

    x: tuple[float, float] = (-0.10, 0.30)
    y: float = 0.34
    width: float = 0.08
    fingertip_offset: tuple[float, float, float] = (0.0, -0.07, 0.08)
    colour: Colour = (70, 74, 80)


@dataclass(frozen=True, slots=True)
class DiscShape:
    """Disc: its sizes [m] and colours (red, green, blue; 0 to 255)."""

    name: str
    radius: float
    height: float
    colour: Colour
    rim_colour: Colour


class Bench:
    """Sizes [m] and colours (red, green, blue; 0 to 255) of everything on the table, as a schema declares them.

    Blocks are the schema's boxes; further blocks are distractors, which are like the first box. `area` bounds the
    places of objects: lowest x, highest x, lowest y, highest y.
    """

    def __init__(self, schema: BenchSchema = TABLETOP, belt: Belt | None = None) -> None:
        self.schema, self.belt = schema, belt
        self.area = tuple(schema.area)
        self.table_colour = _colour(schema.table_colour)
        self.block_names = tuple(schema.boxes)
        self.discs = tuple(_disc_shape(name, disc) for name, disc in schema.discs.items())
        self._edges = tuple(box.size[0] for box in schema.boxes.values())
        self._colours = tuple(_colour(box.colour) for box in schema.boxes.values())

    @property
    def block_edge(self) -> float:
        """Edge of the first block, and of distractors [m]."""
        return self._edges[0]

    def varied(self, size: float, hue: float) -> Bench:
        """Return the bench with all edges of blocks times `size`, and the boxes' colours turned by `hue` [degrees]."""
        other = copy.copy(self)
        other._edges = tuple(round(edge * size, 6) for edge in self._edges)
        other._colours = tuple(_turn(colour, hue) for colour in self._colours)
        return other

    def edge(self, block: int) -> float:
        """Return the edge of the block of that number [m]."""
        return self._edges[block] if block < len(self._edges) else self._edges[0]

    def colour(self, block: int) -> Colour:
        """Return the colour of the block of that number; distractors have colours of the schema in turn."""
        if block < len(self._colours):
            return self._colours[block]
        return _colour(self.schema.distractor_colour(block - len(self._colours)))


def _turn(colour: Colour, hue: float) -> Colour:
    """Return a colour turned by `hue` [degrees] on the colour wheel."""
    if not hue:
        return colour
    at, saturation, value = colorsys.rgb_to_hsv(*(part / 255 for part in colour))
    return _colour(
        [round(255 * part) for part in colorsys.hsv_to_rgb((at + hue / 360) % 1.0, saturation, value)]
    )


def _disc_shape(name: str, disc: Disc) -> DiscShape:
    return DiscShape(name, disc.radius, disc.height, _colour(disc.colour), _colour(disc.rim_colour))


@dataclass(frozen=True, slots=True)
class BenchLayout:
    """Places of the blocks (x, y, yaw) and of the discs (x, y) after a reset.

    They are in the order of the schema; distractors follow the schema's blocks.
    """

    blocks: tuple[tuple[float, float, float], ...]
    discs: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, eq=False)
class BlockState:
    """Pose [4, 4] of a block's centre and axes in the world; `held_by` is the arm that holds it, or ""."""

    pose: Float64
    held_by: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class BenchState:
    """State of every object on the table at one moment."""

    blocks: tuple[BlockState, ...]
    discs: tuple[tuple[float, float], ...]
    light: float = 1.0
    """Brightness of the pictures."""
    camera_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """By how much the overhead camera is moved [m]."""
    size: float = 1.0
    """Edges of the blocks, as a multiple of the usual ones."""
    hue: float = 0.0
    """By how much the boxes' colours are turned on the colour wheel [degrees]."""


@dataclass(frozen=True, slots=True, eq=False)
class PinholeCamera:
    """Camera without distortion; `pose` [4, 4] is its frame in the world: z ahead, x right, y down.

    Pixels are (u, v), columns and rows; integers are the centres of pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    pose: Float64

    @property
    def lens(self) -> Float64:
        """Matrix [3, 3] from camera axes to homogeneous pixels, whose third number is the depth [m]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: Float64) -> Float64:
        """Return the pixels [..., 2] of world points [..., 3]; NaN for points that are not in front of the camera."""
        inside = (np.asarray(points, np.float64) - self.pose[:3, 3]) @ self.pose[:3, :3]
        depth = np.where(inside[..., 2:] > 1e-6, inside[..., 2:], np.nan)
        return np.asarray(inside[..., :2] / depth * (self.fx, self.fy) + (self.cx, self.cy))

    def pixel_to_table(self, u: float, v: float, z: float = 0.0) -> tuple[float, float]:
        """Return the world x, y at which a pixel's ray reaches height `z`.

        Raises:
            BenchError: If the ray never reaches that height.
        """
        ray = self.pose[:3, :3] @ [(u - self.cx) / self.fx, (v - self.cy) / self.fy, 1.0]
        ray_length = (z - self.pose[2, 3]) / ray[2] if abs(ray[2]) > 1e-9 else -1.0
        if ray_length <= 0:
            raise BenchError(f"pixel ({u}, {v}) shows nothing at height {z} m")
        x, y, _ = self.pose[:3, 3] + ray_length * ray
        return float(x), float(y)


def block_pose(block: tuple[float, float, float], edge: float) -> Float64:
    """Return the pose [4, 4] of a block with edges of `edge` [m] that lies flat on the table at (x, y, yaw)."""
    x, y, yaw = block
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    pose[:3, 3] = x, y, edge / 2
    return pose


def yaw_of(pose: Float64) -> float:
    """Return the rotation about z of a pose [4, 4]: that of its x axis, or of its y axis if x points up or down."""
    if math.hypot(pose[0, 0], pose[1, 0]) > 0.1:
        return math.atan2(pose[1, 0], pose[0, 0])
    return math.atan2(-pose[0, 1], pose[1, 1])


def tip_in_world(robot: Robot, arm: Group, q: Float64) -> Float64:
    """Return the pose [4, 4] of an arm's fingertips in the world at joints q [D]: z ahead, y the opening direction."""
    return arm_frames(robot)[arm.name].tip(q)


def camera_arm(robot: Robot, camera: Camera) -> Group | None:
    """Return the arm that carries a camera; None for an overhead camera.

    An arm carries a camera whose name begins with the arm's name without "_arm", or that is named after a wrist if the
    robot has one arm. All other cameras are overhead.
    """
    for arm in robot.arms:
        if camera.name.startswith(arm.name.removesuffix("_arm")):
            return arm
    return robot.arms[0] if "wrist" in camera.name and len(robot.arms) == 1 else None


def cameras(
    robot: Robot,
    q: Float64,
    width: int,
    height: int,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> dict[str, PinholeCamera]:
    """Return all cameras of the robot by key, placed for joints q [D].

    A camera that no arm carries is overhead, moved by `shift` [m].
    """
    carriers = {camera.key: camera_arm(robot, camera) for camera in robot.cameras}
    return {
        key: overhead_camera(width, height, shift)
        if arm is None
        else wrist_camera(tip_in_world(robot, arm, q), width, height, place_wrist_camera(robot, arm.name))
        for key, arm in carriers.items()
    }


def overhead_camera(
    width: int, height: int, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> PinholeCamera:
    """Return the camera above the bench, moved by `shift` [m] without a turn; arms reach into its image from below."""
    pose = _looking(_OVERHEAD_EYE, _OVERHEAD_AIM, up=(0.0, 1.0, 0.0)).copy()
    pose[:3, 3] += shift
    return _camera(pose, _OVERHEAD_FOCAL, width, height)


def wrist_camera(tip: Float64, width: int, height: int, eye: CameraPlacement | None = None) -> PinholeCamera:
    """Return the camera next to the fingers of an arm with fingertips at `tip` [4, 4].

    `eye` is its placement relative to the fingertips; None for the default placement.
    """
    eye = eye or CameraPlacement()
    return _camera(tip @ _looking(eye.place, eye.aim, eye.up), _WRIST_FOCAL, width, height)


def _camera(pose: Float64, focal: float, width: int, height: int) -> PinholeCamera:
    return PinholeCamera(focal * width, focal * width, (width - 1) / 2, (height - 1) / 2, width, height, pose)


@lru_cache(maxsize=64)  # cache: a function of numbers, which have few values
def _looking(eye: tuple[float, ...], aim: tuple[float, ...], up: tuple[float, ...]) -> Float64:
    """Return a camera frame [4, 4] at `eye` that is aimed at `aim`, with `up` towards the top of its image."""
    ahead = np.subtract(aim, eye) / math.dist(aim, eye)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = eye
    pose.setflags(write=False)
    return pose
