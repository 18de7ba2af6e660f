from __future__ import annotations

import errno

import av.error
import pytest

from runtime.cameras.base import Address
from runtime.cameras.open_errors import explain_open_error

DEVICE = Address("/dev/video0", "/dev/video0", "v4l2", {"video_size": "640x480"})
RTSP = Address("rtsp://me:s3cret@127.0.0.1/x", "rtsp://127.0.0.1/x", "rtsp")


def error(number: int) -> Exception:
    """The class of the system's error `number`, as FFmpeg's share it."""
    return OSError(number, "text")


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.EBUSY, "another program has it open"),
        (errno.EACCES, "this user may not open it: is it in the group video?"),
        (errno.ENODEV, "it is no camera"),
        (errno.EINVAL, "it cannot do what was requested (video_size = 640x480)"),
        (errno.EPROTO, "it cannot be read: text"),
    ],
)
def test_what_is_wrong_with_a_device_is_said(number: int, said: str) -> None:
    assert explain_open_error(error(number), DEVICE, 0.0, 5.0, opening=True) == said


def test_whatever_ends_at_the_deadline_was_mute() -> None:
    """FFmpeg's RTSP calls it invalid data when it is interrupted."""
    invalid = av.error.InvalidDataError(av.error.tag_to_code(b"INDA"), "Invalid data")
    assert explain_open_error(invalid, RTSP, 5.01, 5.0, opening=True) == "mute: it sent no picture within 5 s"
    assert (
        explain_open_error(invalid, RTSP, 0.01, 5.0, opening=True)
        == "the server there is not an RTSP server with a video"
    )


def test_an_error_in_the_middle_of_a_stream_is_that_of_the_stream() -> None:
    assert explain_open_error(error(errno.EPROTO), RTSP, 0.0, 2.0, opening=False) == "the stream broke: text"


def test_no_sentence_has_the_password() -> None:
    errors = [error(n) for n in (errno.ECONNREFUSED, errno.EIO, errno.EACCES, errno.ENOENT, errno.EPROTO)]
    errors.append(av.error.HTTPUnauthorizedError(av.error.tag_to_code(b"\xf8401"), "401", RTSP.url))
    for one in errors:
        for opening in (True, False):
            assert "s3cret" not in explain_open_error(one, RTSP, 0.0, 5.0, opening)
