"""Moving test patterns, BGR: a fixed background with the camera's name, blocks that follow the joints, a frame number.

The top strip encodes the frame number as black and white cells, which the receiver of an image can read even after
compression. The bottom row has a red, a green and a blue patch, in this order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float64, UInt8

if TYPE_CHECKING:
    from robots import Robot

BITS = 24  # of the frame number, lowest first
_STRIP = 1 / 30  # share of the image height
_BLUE, _GREEN, _RED = (255, 0, 0), (0, 255, 0), (0, 0, 255)
_BLOCKS = ((60, 60, 235), (60, 200, 60), (220, 140, 40), (40, 200, 230))  # BGR, one per group in turn


class Scene:
    """Renderer of test patterns for all cameras of a robot at [height, width]; `seed` sets the backgrounds' noise."""

    def __init__(self, robot: Robot, height: int, width: int, seed: int = 0) -> None:
        self._robot = robot
        self._span = np.maximum(robot.upper - robot.lower, 1e-9)
        grain = np.random.default_rng(seed)
        self._backgrounds = {
            camera.key: _background(camera.key, index, height, width, grain)
            for index, camera in enumerate(robot.cameras)
        }

    def draw(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """Return a newly allocated BGR uint8 [H, W, 3] image per camera key, for joints [D] at a time."""
        places = np.clip((q - self._robot.lower) / self._span, 0.0, 1.0)
        pictures = {}
        for index, (key, background) in enumerate(self._backgrounds.items()):
            picture = background.copy()
            self._blocks(picture, places, index)
            _sweep(picture, seconds + index)
            _write_number(picture, frame)
            pictures[key] = picture
        return pictures

    def _blocks(self, picture: UInt8, places: Float64, camera: int) -> None:
        """Draw one block per group in its own column: two joints move it, and it is as wide as the group's gripper is
        open.
        """
        height, width = picture.shape[:2]
        side = height // 8
        for index, group in enumerate(self._robot.groups):
            inside = places[group.slice]
            x = int(width * (index + 0.1 + 0.6 * inside[camera % len(inside)]) / len(self._robot.groups))
            y = int(height * (0.15 + 0.6 * inside[(camera + 1) % len(inside)]))
            wide = side if group.gripper is None else int(side * (0.4 + inside[group.gripper.index]))
            picture[y : y + side, x : x + wide] = _BLOCKS[index % len(_BLOCKS)]


def frame_number(picture: UInt8) -> int:
    """Return the number in the top strip of an image of any size and colour order."""
    height, width = picture.shape[:2]
    row = max(0, int(height * _STRIP / 2))
    columns = ((np.arange(BITS) + 0.5) * width / BITS).astype(int)
    bits = picture[row, columns].mean(axis=-1) > 127
    return int(bits @ (1 << np.arange(BITS)))


def _write_number(picture: UInt8, number: int) -> None:
    height, width = picture.shape[:2]
    bits = (number >> np.arange(BITS)) & 1
    cells = (np.arange(width) * BITS) // width
    picture[: int(height * _STRIP)] = (255 * bits[cells])[:, None].astype(np.uint8)


def _sweep(picture: UInt8, seconds: float) -> None:
    """Draw a white bar that crosses the image in four seconds, so that it changes even if the robot is at rest."""
    height, width = picture.shape[:2]
    x = int(width * (seconds % 4.0) / 4.0)
    picture[int(height * 0.86) : int(height * 0.89), x : x + width // 20] = 255


def _background(key: str, index: int, height: int, width: int, grain: np.random.Generator) -> UInt8:
    shade = np.linspace(70, 130, height)[:, None, None] + np.array([18, 0, -18]) * (index - 1)
    shaded = np.broadcast_to(shade, (height, width, 3)) + grain.integers(-6, 7, (height, width, 1))
    picture: UInt8 = np.clip(shaded, 0, 255).astype(np.uint8)
    third = width // 3
    for place, colour in enumerate((_RED, _GREEN, _BLUE)):
        picture[int(height * 0.94) :, place * third : (place + 1) * third] = colour
    return _labelled(picture, key)


def _labelled(picture: UInt8, text: str) -> UInt8:
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((10, picture.shape[0] // 12), text, fill=(235, 235, 235))
    return np.array(image)
