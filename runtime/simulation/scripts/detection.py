"""Detection of blocks and discs by colour in the overhead image.

A scripted policy has no other knowledge of their places. An object that is partly hidden by an arm does not have the
size or shape expected at its place, and is reported as not detected.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float64, UInt8
from runtime.simulation.bench import bench
from runtime.simulation.bench.bench import Bench, BenchError, DiscShape, PinholeCamera

if TYPE_CHECKING:
    from robots import Robot

_NATIVE_WIDTH, _NATIVE_HEIGHT = 640, 480  # size of the overhead camera's image before resizing
_BLACK = 8  # highest value of a letterbox
_FINER = 4  # upsampling for the outline of a block that is ten pixels wide
_HUE = 9  # tolerance of hue to each side, of 180
_SATURATION = 0.45  # least share of the colour's own saturation
_DARKEST = 40  # least value, of 255; low, because colours are also detected in shadow
_BLOCK_SIZE = (0.7, 1.4)  # range of detected area over expected area
_DISC_SIZE = (0.85, 1.2)
_ROUND = 1.15  # largest ratio of longest to shortest width of a disc
_RING = 0.6  # largest share of a ring's enclosed area that has its colour
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])

Matrix = NDArray[Any]  # images and masks, as in OpenCV's own annotations


@dataclass(frozen=True, slots=True)
class Detection:
    """Detected block (x, y, yaw) and plate (x, y) in the world [m, rad]; each is None unless it is fully visible.

    The yaw is that of a square: within 45 degrees of zero. `dark` is True if the image was black.
    """

    block: tuple[float, float, float] | None = None
    plate: tuple[float, float] | None = None
    dark: bool = False


@dataclass(frozen=True, slots=True)
class BenchDetection:
    """All detected blocks (x, y, yaw) by colour, and discs (x, y) by name, in the world [m, rad]."""

    blocks: Mapping[bench.Colour, Sequence[tuple[float, float, float]]] = field(default_factory=dict)
    discs: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    dark: bool = False


class OverheadDetector:
    """Detector in the image of a robot's overhead camera; `key` is the image's name in a request.

    Raises:
        BenchError: If the robot has no overhead camera.
    """

    def __init__(self, robot: Robot, table: Bench | None = None) -> None:
        keys = [camera.key for camera in robot.cameras if bench.camera_arm(robot, camera) is None]
        if not keys:
            raise BenchError(f"{robot.name} has no camera above the bench; all of its cameras are on arms")
        self.key = keys[0]
        self._bench = table or Bench()
        self._camera = bench.overhead_camera(_NATIVE_WIDTH, _NATIVE_HEIGHT)

    def detect(self, picture: UInt8) -> Detection:
        """Detect block and plate in an RGB image [H, W, 3] or [3, H, W] of any size, letterboxed or not.

        Raises:
            BenchError: If the image has another shape.
        """
        image = _without_bars(_channels_last(picture))
        if int(image.max(initial=0)) < _DARKEST:
            return Detection(dark=True)
        hsv = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2HSV)
        contour = _largest(_mask(hsv, self._bench.colour(0)))
        block = None if contour is None else self._block_in(contour, image, self._bench.colour(0))
        return Detection(block, self._disc(hsv, self._bench.discs[0]))

    def detect_all(self, picture: UInt8) -> BenchDetection:
        """Detect all blocks by colour, and all discs by name, in an image as `detect` has it.

        Raises:
            BenchError: If the image has another shape.
        """
        image = _without_bars(_channels_last(picture))
        if int(image.max(initial=0)) < _DARKEST:
            return BenchDetection(dark=True)
        hsv = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2HSV)
        colours = dict.fromkeys(self._bench.colour(index) for index in range(len(self._bench.block_names)))
        discs = {disc.name: self._disc(hsv, disc) for disc in self._bench.discs}
        return BenchDetection(
            {
                colour: tuple(
                    block
                    for contour in _outlines(_mask(hsv, colour))
                    if (block := self._block_in(contour, image, colour)) is not None
                )
                for colour in colours
            },
            {name: place for name, place in discs.items() if place is not None},
        )

    def _block_in(
        self, contour: Matrix, image: UInt8, colour: bench.Colour
    ) -> tuple[float, float, float] | None:
        """Return a block's place and yaw from its silhouette, or None.

        The place is computed from the middle of the smallest rectangle around the silhouette, at half the block's
        height; the yaw from the direction of this rectangle.
        """
        left, top, width, height = cv2.boundingRect(contour)
        rows = slice(max(0, top - 2), top + height + 2)
        columns = slice(max(0, left - 2), left + width + 2)
        crop = cv2.resize(image[rows, columns], None, fx=_FINER, fy=_FINER, interpolation=cv2.INTER_LINEAR)
        outline = _largest(_mask(cv2.cvtColor(crop, cv2.COLOR_RGB2HSV), colour))
        if outline is None:
            return None
        fine = outline[:, 0].astype(np.float64)
        pixels = self._native((fine + 0.5) / _FINER - 0.5 + (columns.start, rows.start), image)
        hull = cv2.convexHull(pixels.astype(np.float32))
        (u, v), sides, angle = cv2.minAreaRect(hull)
        edge = self._bench.block_edge
        x, y = self._camera.pixel_to_table(u, v, edge / 2)
        yaw = self._yaw((u, v), math.radians(angle), max(sides))
        block = (x, y, yaw)
        return block if _within(cv2.contourArea(hull), self._block_area(block), _BLOCK_SIZE) else None

    def _yaw(self, middle: tuple[float, float], angle: float, length: float) -> float:
        """Return the direction in the world [rad], modulo a quarter turn, of a line in the image through `middle`."""
        u, v = middle
        ahead = u + length * math.cos(angle), v + length * math.sin(angle)
        height = self._bench.block_edge / 2
        from_x, from_y = self._camera.pixel_to_table(u, v, height)
        to_x, to_y = self._camera.pixel_to_table(*ahead, height)
        return math.remainder(math.atan2(to_y - from_y, to_x - from_x), math.pi / 2)

    def _block_area(self, block: tuple[float, float, float]) -> float:
        x, y, yaw = block
        turn = np.array([[math.cos(yaw), math.sin(yaw), 0], [-math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        return _area(self._camera, self._bench.block_edge * _CORNERS @ turn + (x, y, 0.0))

    def _disc(self, hsv: Matrix, disc: DiscShape) -> tuple[float, float] | None:
        """Return the middle of the outer edge of a disc's rim.

        A solid area of the rim's colour is no disc but part of a robot.
        """
        mask = _mask(hsv, disc.rim_colour)
        rim = _largest(mask)
        if rim is None or len(rim) < 5:
            return None
        pixels = self._native(rim[:, 0].astype(np.float64), hsv)
        hull = cv2.convexHull(pixels.astype(np.float32))
        (u, v), (width, height), _ = cv2.minAreaRect(hull)
        x, y = self._camera.pixel_to_table(u, v, disc.height)
        turns = np.linspace(0.0, 2 * math.pi, 48, endpoint=False)
        radius = disc.radius
        circle = np.column_stack([x + radius * np.cos(turns), y + radius * np.sin(turns)])
        expected = _area(self._camera, np.insert(circle, 2, disc.height, axis=1))
        is_round = max(width, height) <= _ROUND * min(width, height) and _is_ring(mask, rim)
        return (x, y) if is_round and _within(cv2.contourArea(hull), expected, _DISC_SIZE) else None

    def _native(self, pixels: Float64, image: Matrix) -> Float64:
        """Convert pixels [n, 2] of `image` to pixels of the camera."""
        height, width = image.shape[:2]
        return np.asarray((pixels + 0.5) * (_NATIVE_WIDTH / width, _NATIVE_HEIGHT / height) - 0.5)


def _channels_last(picture: UInt8) -> UInt8:
    if picture.ndim != 3 or 3 not in (picture.shape[0], picture.shape[2]):
        raise BenchError(f"a picture of shape {picture.shape} was given; allowed: [H, W, 3] or [3, H, W]")
    return picture if picture.shape[2] == 3 else np.asarray(cv2.merge(list(picture)), np.uint8)


def _without_bars(picture: UInt8) -> UInt8:
    """Return the image without its letterbox.

    If its margins are not black, it was stretched, and is returned whole.
    """
    height, width = picture.shape[:2]
    ratio = max(_NATIVE_WIDTH / width, _NATIVE_HEIGHT / height)
    inner_width, inner_height = max(1, int(_NATIVE_WIDTH / ratio)), max(1, int(_NATIVE_HEIGHT / ratio))
    top, left = (height - inner_height) // 2, (width - inner_width) // 2
    inner = picture[top : top + inner_height, left : left + inner_width]
    rows = picture[top : top + inner_height]
    bars = picture[:top], picture[top + inner_height :], rows[:, :left], rows[:, left + inner_width :]
    return inner if all(bar.max(initial=0) <= _BLACK for bar in bars) else picture


def _mask(hsv: Matrix, colour: bench.Colour) -> Matrix:
    """Return a mask of the image: 255 for pixels of the colour, in bright or dim light."""
    pixel = cv2.cvtColor(np.array([[colour]], np.uint8), cv2.COLOR_RGB2HSV)[0, 0]
    hue, saturation, _ = (int(part) for part in pixel)
    lowest = max(0, hue - _HUE), int(_SATURATION * saturation), _DARKEST
    mask: Matrix = cv2.inRange(hsv, lowest, (hue + _HUE, 255, 255))
    if hue < _HUE:  # the hue of red is at both ends of the range
        mask |= cv2.inRange(hsv, (180 + hue - _HUE, *lowest[1:]), (179, 255, 255))
    return mask


def _largest(mask: Matrix) -> Matrix | None:
    """Return the outline [n, 1, 2] of the largest region; None if there is none."""
    return max(_outlines(mask), key=cv2.contourArea, default=None)


def _outlines(mask: Matrix) -> Sequence[Matrix]:
    """Return the outline [n, 1, 2] of each region."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return outlines


def _is_ring(mask: Matrix, outline: Matrix) -> bool:
    """Return True if most of the area within the convex hull of an outline [n, 1, 2] is not in the mask."""
    left, top, width, height = cv2.boundingRect(outline)
    inside = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(inside, cv2.convexHull(outline - (left, top)), 1)
    coloured = mask[top : top + height, left : left + width] * inside
    return bool(np.count_nonzero(coloured) <= _RING * np.count_nonzero(inside))


def _area(camera: PinholeCamera, points: Float64) -> float:
    """Return the area of the convex hull of world points [n, 3] in the camera's image [pixels]."""
    return float(cv2.contourArea(cv2.convexHull(camera.project(points).astype(np.float32))))


def _within(measured: float, expected: float, share: tuple[float, float]) -> bool:
    return share[0] * expected <= measured <= share[1] * expected
