import numpy as np
import pytest

from runtime.cameras.base import CameraError, CameraSettings
from runtime.cameras.image_transform import ImageTransform
from runtime.core.errors import ConfigurationError

PICTURE = np.arange(16 * 20 * 3, dtype=np.uint32).reshape(16, 20, 3).astype(np.uint8)


def shaped(**settings):
    return ImageTransform(CameraSettings(**settings))(PICTURE)


def test_without_settings_a_picture_is_as_it_was_contiguous_and_read_only():
    made = shaped()
    assert np.array_equal(made, PICTURE)
    assert made.flags.c_contiguous
    assert not made.flags.writeable


def test_red_and_blue_change_places():
    assert np.array_equal(shaped(colours="bgr"), PICTURE[:, :, [2, 1, 0]])


def test_it_turns_clockwise():
    assert np.array_equal(shaped(rotate=90), np.rot90(PICTURE, 3))
    assert np.array_equal(shaped(rotate=180), PICTURE[::-1, ::-1])
    assert np.array_equal(shaped(rotate=270), np.rot90(PICTURE, 1))
    assert np.array_equal(shaped(rotate=90)[0, -1], PICTURE[0, 0])


def test_it_mirrors():
    assert np.array_equal(shaped(flip="horizontal"), PICTURE[:, ::-1])
    assert np.array_equal(shaped(flip="vertical"), PICTURE[::-1])


def test_it_crops_before_it_turns_and_mirrors_after_that():
    made = shaped(crop=[2, 3, 10, 8], rotate=90, flip="horizontal")
    assert np.array_equal(made, np.rot90(PICTURE[3:11, 2:12], 3)[:, ::-1])


def test_it_is_scaled_last():
    assert shaped(rotate=90, size=[8, 10]).shape == (10, 8, 3)


def test_a_crop_beyond_the_picture_names_both():
    with pytest.raises(CameraError, match=r"crop = \[12, 0, 10, 8\] does not lie within its 20x16 pixels"):
        shaped(crop=[12, 0, 10, 8])


def test_a_crop_that_leaves_nothing_is_a_mistake_of_the_file():
    with pytest.raises(ConfigurationError, match="leaves 4x8"):
        CameraSettings(crop=[0, 0, 4, 8])


def test_a_picture_that_nobody_could_hand_on_says_what_to_set():
    with pytest.raises(CameraError, match=r"2560x1440.*set size or crop"):
        ImageTransform(CameraSettings())(np.zeros((1440, 2560, 3), np.uint8))
    made = ImageTransform(CameraSettings(size=[640, 360]))(np.zeros((1440, 2560, 3), np.uint8))
    assert made.shape == (360, 640, 3)


def test_another_size_later_is_refused_and_the_first_one_taken_again():
    shaping = ImageTransform(CameraSettings())
    shaping(PICTURE)
    with pytest.raises(CameraError, match="were 20x16 and are 10x8 now"):
        shaping(PICTURE[::2, ::2])
    assert shaping(PICTURE).shape == (16, 20, 3)


def test_another_size_of_the_same_shape_is_scaled_where_a_size_is_set():
    shaping = ImageTransform(CameraSettings(size=[20, 16]))
    shaping(PICTURE)
    assert shaping(PICTURE[::2, ::2]).shape == (16, 20, 3)
    with pytest.raises(CameraError, match="of another shape"):
        shaping(PICTURE[::2])


def test_another_size_under_a_crop_shows_another_part_and_is_refused():
    shaping = ImageTransform(CameraSettings(crop=[0, 0, 8, 8], size=[16, 16]))
    shaping(PICTURE)
    with pytest.raises(CameraError, match="without crop"):
        shaping(np.repeat(np.repeat(PICTURE, 2, 0), 2, 1))
