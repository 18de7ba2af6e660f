"""Small pictures on a sheet: which rows each shows, and what stands for those without a picture."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evaweb.episodes.sheets import Grid, sheet
from runtime.recording.files import RecordingError
from runtime.recording.reader import open_episode
from tests.runtime.quality import built

ROBOT, FRAMES = "agilex_piper", 12


@pytest.mark.parametrize(
    ("frames", "grid"),
    [
        (1, Grid(1, 1, 1)),
        (7, Grid(1, 7, 1)),
        (100, Grid(1, 10, 10)),
        (101, Grid(2, 10, 6)),
        (9000, Grid(90, 10, 10)),
    ],
)
def test_an_episode_of_any_length_has_at_most_a_hundred_tiles_that_hold_all_its_rows(
    frames: int, grid: Grid
) -> None:
    assert Grid.of(frames) == grid
    assert grid.across * grid.down * grid.every >= frames


def test_each_tile_shows_its_row_and_one_without_a_picture_is_black(tmp_path: Path) -> None:
    bright = built.shown(
        range(4, FRAMES), lambda index: np.full((built.HEIGHT, built.WIDTH, 3), 200, np.uint8)
    )
    folder = built.record_of(tmp_path, ROBOT, bright, FRAMES)
    video = next(iter(open_episode(folder).videos.values()))
    made = np.asarray(Image.open(io.BytesIO(sheet(video, FRAMES, 8))))
    grid = Grid.of(FRAMES)
    height, width = made.shape[0] // grid.down, made.shape[1] // grid.across
    tiles = [
        made[row * height : (row + 1) * height, column * width : (column + 1) * width].mean()
        for row in range(grid.down)
        for column in range(grid.across)
    ]
    assert all(abs(tile - 200) < 8 for tile in tiles[4:8])
    assert all(tile < 2 for tile in tiles[8:])
    with pytest.raises(RecordingError, match=r"there is no video"):
        sheet(video.with_name("none.mp4"), FRAMES, 8)
