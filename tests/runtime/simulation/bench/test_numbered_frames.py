from __future__ import annotations

import io

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import robots
from runtime.simulation.bench.numbered_frames import Scene, frame_number

ROBOT = robots.load_robot("agilex_piper")
HOME = ROBOT.poses["home"]
SCENE = Scene(ROBOT, 480, 640)


def test_there_is_a_bgr_picture_for_each_camera() -> None:
    pictures = SCENE.draw(0, 0.0, HOME)
    assert list(pictures) == [camera.key for camera in ROBOT.cameras]
    for picture in pictures.values():
        assert picture.shape == (480, 640, 3)
        assert picture.dtype == np.uint8
        patches = [picture[470, x].tolist() for x in (100, 320, 530)]
        assert patches == [[0, 0, 255], [0, 255, 0], [255, 0, 0]]  # red, green, blue, as BGR


@given(st.integers(0, 2**24 - 1))
def test_the_frame_number_can_be_read_back(number: int) -> None:
    for picture in SCENE.draw(number, 1.0, HOME).values():
        assert frame_number(picture) == number


@given(st.integers(0, 2**24 - 1))
def test_the_frame_number_survives_compression_and_shrinking(number: int) -> None:
    picture = SCENE.draw(number, 1.0, HOME)["cam_high"]
    packed = io.BytesIO()
    Image.fromarray(picture[..., ::-1]).resize((320, 240)).save(packed, "JPEG", quality=60)
    assert frame_number(np.asarray(Image.open(packed))) == number


def test_pictures_change_with_the_joints_and_with_time() -> None:
    still = SCENE.draw(1, 1.0, HOME)
    moved = SCENE.draw(1, 1.0, np.clip(HOME + 0.3, ROBOT.lower, ROBOT.upper))
    later = SCENE.draw(1, 1.5, HOME)
    for key in still:
        np.testing.assert_array_equal(still[key], SCENE.draw(1, 1.0, HOME)[key])
        assert (still[key] != moved[key]).any()
        assert (still[key] != later[key]).any()


def test_cameras_do_not_look_alike() -> None:
    front, left, right = SCENE.draw(1, 1.0, HOME).values()
    assert (front != left).mean() > 0.5
    assert (left != right).mean() > 0.5


def test_joints_beyond_their_limits_do_not_leave_the_picture() -> None:
    for q in (ROBOT.upper + 10, ROBOT.lower - 10):
        assert all(picture.shape == (480, 640, 3) for picture in SCENE.draw(0, 0.0, q).values())
