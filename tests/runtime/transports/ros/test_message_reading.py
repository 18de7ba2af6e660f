from __future__ import annotations

import io

import numpy as np
import pytest
import simplejpeg
from PIL import Image as Pillow

from runtime.transports.ros.message_reading import (
    JointOrder,
    UnusableMessage,
    check_picture,
    picture,
    pose,
)
from runtime.transports.ros.messages import CompressedImage, Image, JointState, PoseStamped
from runtime.transports.ros.topics import StreamSpec

PART = StreamSpec("joints", "arm", "/state", "JointState", ("a", "b", "grip"))
RGB = np.zeros((4, 6, 3), np.uint8)
RGB[..., 0], RGB[..., 2] = 200, 30
BIG = np.kron(RGB, np.ones((8, 8, 1), np.uint8))


def joints(names: str, *position: float, **more: list[float]) -> JointState:
    return JointState(
        1,
        "",
        tuple(names.split()),
        np.array(position),
        np.array(more.get("velocity", [])),
        np.array(more.get("effort", [])),
    )


def read(message: JointState, names: str = "check") -> list[float]:
    return JointOrder(PART, "check" if names == "check" else "ignore").read(message)[0].tolist()


def test_joints_are_taken_by_name_in_any_order_and_among_others() -> None:
    assert read(joints("grip other b a", 3, 9, 2, 1)) == [1, 2, 3]


def test_the_order_is_looked_up_anew_where_names_change() -> None:
    order = JointOrder(PART, "check")
    assert order.read(joints("a b grip", 1, 2, 3))[0].tolist() == [1, 2, 3]
    assert order.read(joints("grip b a", 1, 2, 3))[0].tolist() == [3, 2, 1]


def test_velocity_and_effort_are_ordered_alike_and_left_out_where_they_are_short() -> None:
    message = joints("b a grip", 2, 1, 3, velocity=[20, 10, 30], effort=[5])
    _, velocity, effort = JointOrder(PART, "check").read(message)
    assert velocity is not None
    assert velocity.tolist() == [10, 20, 30]
    assert effort is None


def test_messages_without_names_need_exactly_as_many_numbers() -> None:
    assert read(joints("", 1, 2, 3)) == [1, 2, 3]
    with pytest.raises(
        UnusableMessage, match="4 positions without names came; expected 3: a, b, grip"
    ) as caught:
        read(joints("", 1, 2, 3, 4))
    assert caught.value.fault == "wrong_dimension"


@pytest.mark.parametrize(
    ("message", "fault", "text"),
    [
        (joints("a b", 1, 2), "joint_names", "the joints a, b lack grip; expected a, b, grip"),
        (joints("a b grip b", 1, 2, 3, 4), "joint_names", "have b more than once"),
        (joints("a b grip", 1, 2), "wrong_dimension", "3 names came with 2 positions"),
        (joints("a b grip", 1, float("nan"), 3), "not_finite", "expected finite numbers"),
    ],
)
def test_doubtful_joints_are_refused(message: JointState, fault: str, text: str) -> None:
    with pytest.raises(UnusableMessage, match=text) as caught:
        read(message)
    assert caught.value.fault == fault


def test_names_may_be_ignored_where_a_deployment_says_so() -> None:
    assert read(joints("x y z more", 1, 2, 3, 4), "ignore") == [1, 2, 3]
    with pytest.raises(UnusableMessage, match="2 positions"):
        read(joints("x y", 1, 2), "ignore")


def raw(encoding: str, pixels: np.ndarray, padding: int = 0) -> Image:
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    padded = np.hstack([rows, np.full((height, padding), 77, np.uint8)])
    return Image(1, "", height, width, encoding, padded.shape[1], np.frombuffer(padded.tobytes(), np.uint8))


ALPHA = np.full((4, 6, 1), 9, np.uint8)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("rgba8", np.concatenate([RGB, ALPHA], 2), RGB),
        ("bgra8", np.concatenate([RGB[..., ::-1], ALPHA], 2), RGB),
        ("mono8", RGB[..., :1], np.repeat(RGB[..., :1], 3, 2)),
    ],
)
def test_raw_pictures_become_rgb_whatever_their_encoding_and_padding(
    encoding: str, pixels: np.ndarray, expected: np.ndarray, padding: int
) -> None:
    made = picture(raw(encoding, pixels, padding))
    assert np.array_equal(made, expected)
    assert not made.flags.writeable


def png(pixels: np.ndarray, mode: str | None = None) -> np.ndarray:
    out = io.BytesIO()
    image = Pillow.fromarray(pixels)
    (image if mode is None else image.convert(mode)).save(out, "PNG")
    return np.frombuffer(out.getvalue(), np.uint8)


def jpeg(pixels: np.ndarray) -> np.ndarray:
    return np.frombuffer(simplejpeg.encode_jpeg(np.ascontiguousarray(pixels), 95), np.uint8)


@pytest.mark.parametrize("said", ["jpeg", "bgr8; jpeg compressed bgr8", "rgb8; jpeg compressed bgr8"])
def test_jpegs_become_rgb(said: str) -> None:
    made = picture(CompressedImage(1, "", said, jpeg(BIG)))
    assert np.abs(made.astype(int) - BIG).max() < 6
    assert not made.flags.writeable


def test_pngs_become_rgb() -> None:
    assert np.array_equal(picture(CompressedImage(1, "", "png", png(RGB))), RGB)
    grey = picture(CompressedImage(1, "", "mono8; png compressed", png(RGB[..., 0])))
    assert np.array_equal(grey, np.repeat(RGB[..., :1], 3, 2))


def test_a_file_whose_colours_image_transport_left_swapped_is_swapped_back() -> None:
    made = picture(CompressedImage(1, "", "rgb8; jpeg compressed rgb8", jpeg(BIG[..., ::-1])))
    assert np.abs(made.astype(int) - BIG).max() < 6


def compressed(said: str, data: np.ndarray) -> CompressedImage:
    return CompressedImage(1, "", said, data)


@pytest.mark.parametrize(
    ("message", "fault", "text"),
    [
        (raw("16UC1", RGB), "wrong_encoding", "'16UC1'; allowed: bgr8, bgra8, mono8, rgb8, rgba8"),
        (raw("8UC3", RGB), "wrong_encoding", "'8UC3'; allowed"),
        (raw("rgba8", RGB), "wrong_dimension", "rows of 18 bytes"),
        (Image(1, "", 4, 6, "rgb8", 18, RGB.reshape(-1)[:-1]), "wrong_dimension", "71 bytes; expected at"),
        (Image(1, "", 0, 6, "rgb8", 18, RGB.reshape(-1)), "wrong_dimension", "6 x 0 pixels"),
        (
            Image(1, "", 2**31, 2**31, "rgb8", 2**32 - 1, RGB.reshape(-1)),
            "wrong_dimension",
            "pixels; allowed",
        ),
        (
            compressed("jpeg", np.zeros(0, np.uint8)),
            "wrong_encoding",
            "begins with nothing; allowed: jpeg, png",
        ),
        (compressed("16UC1; compressedDepth", png(RGB)), "wrong_encoding", "not compressedDepth"),
    ],
)
def test_unknown_or_impossible_pictures_are_refused_before_decoding(
    message: Image | CompressedImage, fault: str, text: str
) -> None:
    with pytest.raises(UnusableMessage, match=text) as caught:
        check_picture(message)
    assert caught.value.fault == fault


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (jpeg(BIG)[:200], "broken_picture"),
        (png(BIG)[:60], "broken_picture"),
        (png(np.zeros((2, 2), np.uint16)), "wrong_encoding"),
    ],
)
def test_broken_files_are_refused(data: np.ndarray, fault: str) -> None:
    message = CompressedImage(1, "", "jpeg or png", data)
    check_picture(message)
    with pytest.raises(UnusableMessage) as caught:
        picture(message)
    assert caught.value.fault == fault


def test_a_pose_is_turned_to_scalar_first_and_made_unit() -> None:
    made = pose(PoseStamped(1, "base", np.array([1, 2, 3, 0.1, 0.2, 0.3, 0.9]) * 1.0), "base")
    length = np.sqrt(0.01 + 0.04 + 0.09 + 0.81)
    np.testing.assert_allclose(
        made, [1, 2, 3, 0.9 / length, 0.1 / length, 0.2 / length, 0.3 / length], rtol=1e-6
    )


@pytest.mark.parametrize(
    ("numbers", "frame", "fault"),
    [
        ([0, 0, 0, 0, 0, 0, 0], "base", "bad_pose"),
        ([0, 0, float("nan"), 0, 0, 0, 1], "base", "bad_pose"),
        ([0, 0, 0, 0, 0, 0, 1], "camera", "wrong_frame"),
    ],
)
def test_a_pose_that_is_none_or_in_another_frame_is_refused(
    numbers: list[float], frame: str, fault: str
) -> None:
    with pytest.raises(UnusableMessage) as caught:
        pose(PoseStamped(1, frame, np.array(numbers)), "base")
    assert caught.value.fault == fault
