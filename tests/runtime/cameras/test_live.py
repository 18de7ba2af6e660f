"""Live cameras against stand-in servers on loopback."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from runtime.cameras import mjpeg, rtsp, v4l2
from runtime.cameras.base import Condition
from runtime.cameras.live import LiveCamera
from runtime.clock import MonotonicClock
from runtime.sim.camera_server import CameraServer
from runtime.sim.mjpeg_server import MjpegServer
from runtime.sim.rtsp_server import RtspServer
from tests.runtime.cameras.movies import until

CLOCK = MonotonicClock()
KINDS = {"rtsp": (RtspServer, rtsp), "mjpeg": (MjpegServer, mjpeg)}
both = pytest.mark.parametrize("kind", KINDS)


@contextmanager
def looking(module: ModuleType, url: str, **settings: Any) -> Iterator[LiveCamera]:
    config = module.Config(url=url, **{"open_s": 1.5, "read_s": 0.5, **settings})
    camera = LiveCamera("wrist", config.kind, config, module.address(config), CLOCK)
    camera.start()
    try:
        yield camera
    finally:
        camera.close()


@contextmanager
def watched(kind: str, fault: str = "", **settings: Any) -> Iterator[tuple[CameraServer, LiveCamera]]:
    made, module = KINDS[kind]
    server = made()
    server.fault = fault
    try:
        with looking(module, server.start(), **settings) as camera:
            yield server, camera
    finally:
        server.close()


def live(camera: LiveCamera) -> bool:
    return camera.health().condition is Condition.LIVE


def lost(camera: LiveCamera) -> bool:
    return camera.health().condition is Condition.LOST


@both
def test_pictures_are_rgb_new_and_never_from_the_future(kind: str) -> None:
    with watched(kind) as (_, camera):
        until(camera.newest)
        first = camera.newest()
        assert first is not None
        assert first.picture.shape == (120, 160, 3)
        np.testing.assert_allclose(first.picture[10, 10], (220, 0, 0), atol=12)
        np.testing.assert_allclose(first.picture[10, -10], (0, 0, 220), atol=12)
        assert first.captured <= first.arrived <= CLOCK.now()
        until(lambda: camera.newest().captured > first.captured)  # type: ignore[union-attr]
        assert camera.health().why == ""


@both
def test_settings_shape_its_pictures(kind: str) -> None:
    with watched(kind, rotate=90, size=[60, 80], colours="bgr") as (_, camera):
        until(camera.newest)
        shot = camera.newest()
        assert shot is not None
        assert shot.picture.shape == (80, 60, 3)
        np.testing.assert_allclose(
            shot.picture[5, 30], (0, 0, 220), atol=12
        )  # red was on the left, is on top


ABSENT = [
    ("rtsp", "mute", "mute: it sent no picture within 0.5 s"),
    ("rtsp", "garbage", "what answers there is no RTSP server with a video"),
    ("rtsp", "not_found", "404: there is nothing at that path"),
    ("rtsp", "no_login", "it wants a login: set user and password_env, or correct them"),
    ("rtsp", "torn", "it closed the connection"),
    ("rtsp", "nonsense", "what it sent for 0.5 s cannot be decoded"),
    ("rtsp", "trickle", "mute: it sent no picture within 0.5 s"),
    ("mjpeg", "trickle", "mute: it sent no picture within 0.5 s"),
    ("rtsp", "silent", "mute: it sent no picture within 0.5 s"),
    ("mjpeg", "silent", "mute: it sent no picture within 0.5 s"),
    ("mjpeg", "mute", "mute: it sent no picture within 0.5 s"),
    ("mjpeg", "garbage", "no MJPEG stream: it answers with something else, not multipart/x-mixed-replace"),
    ("mjpeg", "not_found", "404: there is nothing at that path"),
    ("mjpeg", "no_login", "it wants a login: set user and password_env, or correct them"),
    ("mjpeg", "html", "no MJPEG stream: it answers with text/html, not multipart/x-mixed-replace"),
    ("mjpeg", "torn", "its stream ends before the first picture"),
    ("mjpeg", "nonsense", "what it sent for 0.5 s cannot be decoded"),
]


@pytest.mark.parametrize(("kind", "fault", "why"), ABSENT)
def test_what_was_found_in_its_place_is_said(kind: str, fault: str, why: str) -> None:
    with watched(kind, fault, open_s=0.5) as (_, camera):
        until(lambda: camera.health().failed)
        assert (camera.health().condition, camera.health().why) == (Condition.OPENING, why)
        assert camera.newest() is None


@both
def test_a_port_at_which_nobody_listens_refuses(kind: str) -> None:
    made, module = KINDS[kind]
    server = made()
    url = server.start()
    server.close()
    with looking(module, url) as camera:
        until(lambda: camera.health().failed)
        assert camera.health().why == "refused: nothing listens at that port"


def test_an_unknown_host_is_named() -> None:
    with looking(rtsp, "rtsp://no-such-host.invalid/x") as camera:
        until(lambda: camera.health().failed)
        assert camera.health().why == "the host no-such-host.invalid is not known"


@both
@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ("silent", "mute: it sent no picture within 0.5 s"),
        ("torn", "it closed the connection"),
        ("nonsense", "what it sent for 0.5 s cannot be decoded"),
    ],
)
def test_what_breaks_while_it_plays_is_lost_and_comes_back(kind: str, fault: str, why: str) -> None:
    with watched(kind) as (server, camera):
        until(lambda: live(camera))
        server.fault = fault
        until(lambda: lost(camera))
        health, kept = camera.health(), camera.newest()
        assert health.losses == 1
        assert health.why.startswith(why)
        assert kept is not None, "the newest picture stays, and grows old"
        server.fault = ""
        until(lambda: live(camera))
        assert camera.newest().captured > kept.captured  # type: ignore[union-attr]


@both
def test_a_server_that_stops_and_comes_back_is_found_again(kind: str) -> None:
    with watched(kind) as (server, camera):
        until(lambda: live(camera))
        server.close()
        until(lambda: "refused" in camera.health().why)
        since = camera.health().since
        assert camera.health().condition is Condition.LOST
        server.start()
        until(lambda: live(camera))
        assert camera.health().since > since


@both
def test_another_resolution_is_refused_until_it_is_set_back(kind: str) -> None:
    with watched(kind) as (server, camera):
        until(lambda: live(camera))
        server.size = (80, 60)
        until(lambda: lost(camera))
        assert "were 160x120 and are 80x60 now" in camera.health().why
        assert camera.newest().picture.shape == (120, 160, 3)  # type: ignore[union-attr]
        server.size = (160, 120)
        until(lambda: live(camera))


def test_a_slow_camera_is_no_lost_one() -> None:
    with watched("mjpeg", read_s=2.0) as (server, camera):
        until(lambda: live(camera))
        server.rate = 4.0
        seen: set[float] = set()
        until(lambda: seen.add(camera.newest().captured) or len(seen) > 3)  # type: ignore[func-returns-value, union-attr]
        assert (camera.health().condition, camera.health().losses) == (Condition.LIVE, 0)


def test_a_stream_whose_time_jumps_is_counted_and_its_pictures_stay_new() -> None:
    with watched("rtsp") as (server, camera):
        assert isinstance(server, RtspServer)
        until(lambda: live(camera))
        for count, offset in enumerate((100.0, 0.0), 1):
            server.stamp_offset = offset
            until(lambda count=count: camera.faults() == {"camera_clock_jumped_wrist": count})
            jumped = CLOCK.now()
            until(lambda jumped=jumped: camera.newest().captured > jumped)  # type: ignore[union-attr]
        assert camera.health().losses == 0


def test_a_mute_camera_does_not_keep_another_one_waiting_and_both_end() -> None:
    with watched("rtsp", "mute") as (_, mute), watched("mjpeg") as (_, playing):
        until(lambda: live(playing))
        assert mute.newest() is None
    until(lambda: not [t for t in threading.enumerate() if t.name == "camera-wrist"])


def test_a_reader_that_never_returns_is_noticed_from_outside() -> None:
    class Stopped(MonotonicClock):
        late = 0.0

        def now(self) -> float:
            return super().now() + self.late

    with watched("mjpeg") as (_, camera):
        until(lambda: live(camera))
        camera.close()  # nobody reads any more, as if it hung in a driver
        clock = Stopped()
        clock.late = 60.0
        camera._clock = clock
        health = camera.health()
        assert (health.condition, health.losses) == (Condition.LOST, 1)
        assert health.why == "no picture for over 1.5 s, and reading it does not return"


def test_a_device_that_is_not_there_is_said() -> None:
    config = v4l2.Config(device="/dev/video-none")
    camera = LiveCamera("wrist", "v4l2", config, v4l2.address(config), CLOCK)
    camera.start()
    until(lambda: camera.health().failed)
    assert camera.health().why.startswith("there is no such device; this machine has ")
    camera.close()


def test_a_device_that_is_no_camera_is_said() -> None:
    config = v4l2.Config(device="/dev/null", read_s=0.5)
    camera = LiveCamera("wrist", "v4l2", config, v4l2.address(config), CLOCK)
    camera.start()
    until(lambda: camera.health().failed)
    assert camera.health().why == "it is no camera"
    camera.close()
