from typing import Any

import pytest

from runtime.core.errors import RecordingError
from runtime.recording.layout import Layout

from .samples import CAMERAS, manifest


def test_it_reads_what_decides_the_files() -> None:
    layout = Layout.from_manifest(manifest())
    assert layout.streams == ("qvel", "eef", "eef_action")
    assert (layout.dim, layout.eef_dim, layout.fps, layout.started) == (3, 8, 30.0, 1000.0)
    assert layout.cameras == dict.fromkeys(CAMERAS, (48, 64))
    assert [layout.width(name) for name in layout.streams] == [3, 8, 8]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 2}, "format is 2, must be 1"),
        ({"uuid": "../elsewhere"}, "uuid is '../elsewhere'"),
        ({"uuid": "{C0FFEE00-0000-4000-8000-000000000000}"}, "lower case"),
        ({"uuid": None}, "uuid is None"),
        ({"fps": 0}, "fps is 0"),
        ({"fps": float("nan")}, "fps is nan"),
        ({"fps": True}, "fps is True"),
        ({"started_monotonic": "now"}, "started_monotonic is 'now'"),
        ({"robot": {"dim": 0, "eef_dim": 8}}, "dim is 0"),
        ({"robot": {"dim": 3}}, "eef_dim is None"),
        ({"robot": None}, "robot is None"),
        ({"cameras": {"a/b": {"width": 64, "height": 48}}}, "a/b"),
        ({"cameras": {"": {"width": 64, "height": 48}}}, "can name a file"),
        ({"cameras": {"a": {"width": 63, "height": 48}}}, "63x48"),
        ({"cameras": {"a": 3}}, r"cameras\.a is 3"),
        ({"cameras": {"a": {"width": "64", "height": 48}}}, "width is '64'"),
        ({"capture_streams": "joints"}, "capture_streams is 'joints'"),
    ],
)
def test_what_is_wrong_is_named_with_what_is_allowed(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        Layout.from_manifest(manifest(**changes))


def test_a_robot_without_arms_needs_no_pose_width() -> None:
    layout = Layout.from_manifest(manifest(robot={"dim": 3}, streams={}, cameras={}, capture_streams=()))
    assert layout.eef_dim == 0
    assert layout.streams == ()
