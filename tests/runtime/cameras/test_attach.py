from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from runtime.cameras.attach import attach_cameras
from runtime.cameras.live_camera import LiveCamera
from runtime.cameras.source_with_cameras import SourceWithCameras
from runtime.config import loader
from runtime.core.clock import MonotonicClock, VirtualClock
from runtime.core.errors import ConfigurationError, SetupError
from runtime.processes.reception.process import make_source
from runtime.station.checks import check_deployment
from runtime.station.spec import StationSpec
from runtime.transports.node_source import NodeSource

HIGH = {"kind": "mjpeg", "url": "http://127.0.0.1:1/x"}


def planned(tmp_path: Path, cameras: dict[str, Any], **transport: Any) -> StationSpec:
    tree = {
        "station": "bench",
        "robot": "agilex_piper",
        "data_dir": str(tmp_path),
        "transport": {"kind": "zmq", **transport},
        "policy": {"kind": "mock"},
        "cameras": cameras,
    }
    return check_deployment(loader.resolve_deployment(tree, {}, "test.toml"))


def waits_for(spec: StationSpec) -> set[str]:
    """The cameras that the transport itself must deliver."""
    source = make_source(spec, MonotonicClock())
    inner = source._source if isinstance(source, SourceWithCameras) else source
    assert isinstance(inner, NodeSource)
    return set(inner._messages._cameras)


def test_a_transport_does_not_wait_for_a_camera_that_comes_from_elsewhere(tmp_path: Path) -> None:
    robots = planned(tmp_path, {})
    ours = planned(tmp_path, {"cam_high": HIGH})
    assert waits_for(robots) == set(robots.cameras)
    assert waits_for(ours) == set(robots.cameras) - {"cam_high"}
    assert ours.cameras == robots.cameras == ours.layout.cameras


def test_a_camera_that_the_transport_leaves_out_may_come_from_elsewhere(tmp_path: Path) -> None:
    spec = planned(tmp_path, {"cam_high": HIGH}, disabled_cameras=["cam_high"])
    assert "cam_high" in spec.cameras
    assert waits_for(spec) == set(spec.cameras) - {"cam_high"}


def test_without_cameras_of_its_own_a_source_is_itself() -> None:
    source = NodeSource.__new__(NodeSource)
    assert attach_cameras(source, {}, MonotonicClock()) is source


def test_a_camera_that_the_robot_does_not_have_is_refused_with_those_it_has(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigurationError, match=r"cameras\.cam_top: .* has no such camera; allowed: cam_high"
    ):
        planned(tmp_path, {"cam_top": HIGH})


def test_a_password_that_is_not_set_is_refused_before_anything_is_connected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CAMERA_PASSWORD", raising=False)
    wanted = {"kind": "rtsp", "url": "rtsp://h/x", "user": "me", "password_env": "CAMERA_PASSWORD"}
    with pytest.raises(ConfigurationError, match=r"cameras\.cam_high: password_env names CAMERA_PASSWORD"):
        planned(tmp_path, {"cam_high": wanted})


def test_a_password_is_in_no_manifest_and_in_no_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAMERA_PASSWORD", "s3cret")
    wanted = {"kind": "rtsp", "url": "rtsp://h/x", "user": "me", "password_env": "CAMERA_PASSWORD"}
    spec = planned(tmp_path, {"cam_high": wanted})
    source = make_source(spec, MonotonicClock())
    assert isinstance(source, SourceWithCameras)
    (camera,) = source._cameras
    assert isinstance(camera, LiveCamera)
    assert "s3cret" in camera._address.url
    assert "s3cret" not in str(spec.resolved.tree) + repr(camera._address) + str(source.camera_health())


@pytest.mark.parametrize(
    ("table", "named"),
    [
        (
            {"kind": "usb"},
            r"cameras\.cam_high\.kind = 'usb': must be one of .*'file'.*'mjpeg'.*'rtsp'.*'v4l2'",
        ),
        ({"kind": "v4l2", "device": "video0"}, r"cameras\.cam_high\.device = 'video0'"),
        ({"kind": "rtsp", "url": "http://h/x"}, r"url = 'http://h/x'; allowed: rtsp://HOST"),
        ({"kind": "mjpeg", "url": "rtsp://h/x"}, r"url = 'rtsp://h/x'; allowed: http://HOST"),
        (HIGH | {"rotate": 45}, r"cameras\.cam_high\.rotate = 45"),
        (HIGH | {"size": [640]}, r"cameras\.cam_high\.size = \[640\]"),
        (HIGH | {"sise": [640, 480]}, r"unknown key \(did you mean size\?\)"),
    ],
)
def test_a_wrong_table_names_the_key_and_what_is_allowed(
    tmp_path: Path, table: dict[str, Any], named: str
) -> None:
    with pytest.raises(ConfigurationError, match=named):
        planned(tmp_path, {"cam_high": table})


def test_on_a_virtual_clock_there_is_no_live_camera(tmp_path: Path) -> None:
    with pytest.raises(
        SetupError, match=r"cameras\.cam_high: kind 'mjpeg' runs in real time.*allowed there: 'file'"
    ):
        make_source(planned(tmp_path, {"cam_high": HIGH}), VirtualClock())


def test_a_device_is_asked_for_what_the_table_says(tmp_path: Path) -> None:
    from runtime.cameras import v4l2

    table = {"frame_size": [640, 480], "frame_rate": 30.0, "pixel_format": "mjpeg"}
    address = v4l2.address(v4l2.Config(device="/dev/video0", **table))
    assert (address.url, address.format) == ("/dev/video0", "v4l2")
    assert address.options == {"video_size": "640x480", "framerate": "30", "input_format": "mjpeg"}
