from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from runtime.policies.pictures import resize_image, to_layout


def picture(height: int, width: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.random.default_rng(0).integers(1, 256, (height, width, 3), dtype=np.uint8)


def test_padding_keeps_the_aspect_and_centres_on_black() -> None:
    result = resize_image(picture(480, 640), 224, 224, "pad")
    assert result.shape == (224, 224, 3)
    assert result[:28].max() == 0
    assert result[196:].max() == 0
    assert (result[28:196].max(axis=-1) > 0).all()


def test_the_inside_is_pillows_bilinear_picture() -> None:
    given_picture = picture(480, 640)
    inside = Image.fromarray(given_picture).resize((224, 168), Image.Resampling.BILINEAR)
    np.testing.assert_array_equal(resize_image(given_picture, 224, 224, "pad")[28:196], np.asarray(inside))


def test_sides_are_rounded_down_as_openpi_rounds_them() -> None:
    result = resize_image(picture(360, 640), 224, 224, "pad")  # 126 rows between 49 and 49
    assert result[:49].max() == 0
    assert result[49].max() > 0
    assert result[174].max() > 0
    assert result[175:].max() == 0
    uneven = resize_image(picture(100, 300), 32, 32, "pad")  # 10 rows, 11 above and 11 below
    assert [int(row.max() > 0) for row in uneven] == [0] * 11 + [1] * 10 + [0] * 11


def test_stretching_fills_the_whole() -> None:
    given_picture = picture(480, 640)
    expected = Image.fromarray(given_picture).resize((224, 224), Image.Resampling.BILINEAR)
    np.testing.assert_array_equal(resize_image(given_picture, 224, 224, "stretch"), np.asarray(expected))


@pytest.mark.parametrize("how", ["pad", "stretch"])
def test_a_picture_of_the_right_size_is_not_touched(how: str) -> None:
    given_picture = picture(64, 48)
    assert resize_image(given_picture, 64, 48, how) is given_picture  # type: ignore[arg-type]


@given(st.integers(1, 60), st.integers(1, 60), st.integers(8, 40), st.integers(8, 40))
def test_any_size_fits_any_size(rows: int, columns: int, height: int, width: int) -> None:
    result = resize_image(picture(rows, columns), height, width, "pad")
    assert result.shape == (height, width, 3)
    assert result.max() > 0


def test_layouts_are_contiguous() -> None:
    given_picture = picture(4, 6)
    planes = to_layout(given_picture, "chw")
    assert planes.shape == (3, 4, 6)
    assert planes.flags.c_contiguous
    np.testing.assert_array_equal(planes[2], given_picture[..., 2])
    assert to_layout(given_picture[:, ::-1], "hwc").flags.c_contiguous
