import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.transports.frozen_cameras import FROZEN_S, FrozenCameraDetector


def picture(value, shape=(48, 64, 3)):
    return np.full(shape, value, np.uint8)


def test_a_new_picture_has_the_time_of_its_message():
    freshness = FrozenCameraDetector()
    assert freshness.captured({"left": picture(1), "right": picture(2)}, 5.0) == {"left": 5.0, "right": 5.0}
    assert freshness.captured({"left": picture(3), "right": picture(4)}, 6.0) == {"left": 6.0, "right": 6.0}


def test_a_picture_like_the_one_before_keeps_the_time_of_the_first_of_them():
    freshness = FrozenCameraDetector()
    for time in (5.0, 5.1, 5.2):
        assert freshness.captured({"left": picture(1), "right": picture(time)}, time)["left"] == 5.0
    assert freshness.captured({"left": picture(2)}, 5.3) == {"left": 5.3}
    assert freshness.captured({"left": picture(1)}, 5.4) == {"left": 5.4}  # seen long ago is new again


@given(
    row=st.integers(0, 47), column=st.integers(0, 63), channel=st.integers(0, 2), value=st.integers(1, 255)
)
def test_one_number_that_differs_makes_a_new_picture(row, column, channel, value):
    freshness = FrozenCameraDetector()
    freshness.captured({"left": picture(0)}, 1.0)
    other = picture(0)
    other[row, column, channel] = value
    assert freshness.captured({"left": other}, 2.0) == {"left": 2.0}


def test_a_picture_of_another_size_is_a_new_one():
    freshness = FrozenCameraDetector()
    freshness.captured({"left": picture(0)}, 1.0)
    assert freshness.captured({"left": picture(0, (24, 64, 3))}, 2.0) == {"left": 2.0}


def test_a_camera_that_freezes_is_named_once_and_again_after_it_has_moved():
    freshness = FrozenCameraDetector()
    named = []
    for tick in range(100):
        value = tick if 45 <= tick < 55 else 0
        freshness.captured({"left": picture(value), "right": picture(tick)}, tick / 32)
        named += [(tick, camera) for camera in freshness.newly_frozen(tick / 32)]
    first = int(FROZEN_S * 32) + 1
    assert named == [(first, "left"), (55 + first, "left")]


def test_nobody_is_frozen_before_anything_was_seen():
    assert FrozenCameraDetector().newly_frozen(1e9) == []


@pytest.mark.parametrize("time", [4.0, 5.0])
def test_a_clock_that_stands_or_goes_back_freezes_nobody(time):
    freshness = FrozenCameraDetector()
    freshness.captured({"left": picture(1)}, 5.0)
    assert freshness.newly_frozen(time) == []
