from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.recording.video import to_yuv_planes
from tests.examples import some

LUMA = np.array([65.481, 128.553, 24.966]) / 255  # ITU-R BT.601, limited range
BLUE, RED = np.array([-37.797, -74.203, 112.0]) / 255, np.array([112.0, -93.786, -18.214]) / 255


def exact(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The planes as the standard has them; colours of the mean of four pixels."""
    height, width = picture.shape[:2]
    rgb = picture.astype(float)
    mean = rgb.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
    return 16 + rgb @ LUMA, 128 + mean @ BLUE, 128 + mean @ RED


def made(picture: np.ndarray, size: tuple[int, int]) -> list[np.ndarray]:
    height, width = size
    whole = to_yuv_planes(picture, size).to_ndarray().astype(float)
    return [whole[:height], *whole[height:].reshape(2, height // 2, width // 2)]


@given(
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(4, 40),
    width=st.integers(4, 40),
    kind=st.integers(0, 2),
)
@settings(max_examples=some(60))
def test_every_plane_is_that_of_the_standard_to_within_its_rounding(
    seed: int, height: int, width: int, kind: int
) -> None:
    drawn = np.random.default_rng(seed)
    size = 2 * height, 2 * width
    picture = (
        drawn.integers(0, 256, (*size, 3)),
        255 * drawn.integers(0, 2, (*size, 3)),
        np.broadcast_to(drawn.integers(0, 256, 3), (*size, 3)),
    )[kind].astype(np.uint8)
    for plane, wanted in zip(made(picture, size), exact(picture), strict=True):
        assert plane.shape == wanted.shape
        assert np.abs(plane - wanted).max() < 1.5
        assert np.abs((plane - wanted).mean()) < 0.6


@pytest.mark.parametrize("size", [(24, 32), (32, 48), (10, 14), (96, 128)])
def test_pictures_of_another_size_are_scaled_first(size: tuple[int, int]) -> None:
    shades = np.linspace(0, 255, 64).astype(np.uint8)
    picture = np.broadcast_to(shades[None, :, None], (48, 64, 3))
    luma, blue, red = made(picture, size)
    assert luma.shape == size
    assert np.abs(luma.mean() - exact(picture)[0].mean()) < 2
    assert np.all(np.diff(luma.mean(axis=0)) >= 0)
    assert np.abs(np.concatenate([blue, red]) - 128).max() <= 1


def test_the_frame_says_how_its_colours_are_written_and_keeps_its_pixels() -> None:
    frame = to_yuv_planes(np.full((16, 16, 3), 200, np.uint8), (16, 16))
    other = to_yuv_planes(np.zeros((16, 16, 3), np.uint8), (16, 16))
    assert (frame.format.name, frame.width, frame.height) == ("yuv420p", 16, 16)
    assert (int(frame.colorspace), int(frame.color_range)) == (5, 1)
    assert frame.to_ndarray()[0, 0] == 188
    assert other.to_ndarray()[0, 0] == 16
