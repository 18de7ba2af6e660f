"""Sheets of small images of a whole episode, one per camera, which pages show along the time axis."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from pathlib import Path

import numpy as np
import simplejpeg
from PIL import Image

from runtime.datasets.video_frames import VideoFrames
from runtime.recording.files import RecordingError

MOST = 100  # tiles
ACROSS = 10
WIDTH = 160  # width of a tile [px]
QUALITY = 70


@dataclass(frozen=True, slots=True)
class Grid:
    """Layout of a sheet of `across` x `down` tiles, which are filled row by row from the top left.

    A tile stands for a number of consecutive rows of the episode, given by `every`, and shows one image of them. Tile k
    starts at row k * `every`.
    """

    every: int
    across: int
    down: int

    @classmethod
    def of(cls, frames: int) -> Grid:
        """Return the grid of an episode with `frames` rows."""
        every = max(1, ceil(frames / MOST))
        tiles = ceil(frames / every)
        return cls(every, min(tiles, ACROSS), ceil(tiles / ACROSS))


def sheet(video: Path, frames: int, shown: int) -> bytes:
    """Return the sheet of a camera as a JPEG; `shown` of the `frames` rows have an image, other tiles are black.

    A tile whose image cannot be decoded is black too. Raises: RecordingError if the video cannot be read at all.
    """
    grid = Grid.of(frames)
    with VideoFrames(video) as pictures:
        height = max(1, round(pictures.size[0] * WIDTH / pictures.size[1]))
        canvas = np.zeros((grid.down * height, grid.across * WIDTH, 3), np.uint8)
        for tile, first in enumerate(range(0, shown, grid.every)):
            row, column = divmod(tile, grid.across)
            try:
                picture = Image.fromarray(pictures[min(first + grid.every // 2, shown - 1)])
            except RecordingError:
                continue
            small = np.asarray(picture.resize((WIDTH, height), Image.Resampling.BILINEAR, reducing_gap=2.0))
            canvas[row * height : (row + 1) * height, column * WIDTH : (column + 1) * WIDTH] = small
    jpeg: bytes = simplejpeg.encode_jpeg(canvas, quality=QUALITY)
    return jpeg
