"""Live cameras against stand-in servers on loopback; what can be wrong is in tests/conformance."""

from __future__ import annotations

import threading

import numpy as np

from runtime.cameras import rtsp, v4l2
from runtime.cameras.base import CameraCondition
from runtime.cameras.live_camera import LiveCamera
from runtime.core.clock import MonotonicClock
from runtime.standins.rtsp_server import RtspServer
from tests.runtime.cameras.movies import until
from tests.runtime.cameras.watched import CLOCK, both, live, looking, watched


@both
def test_pictures_are_rgb_new_and_never_from_the_future(kind: str) -> None:
    with watched(kind) as (_, camera):
        until(camera.latest)
        first = camera.latest()
        assert first is not None
        assert first.picture.shape == (120, 160, 3)
        np.testing.assert_allclose(first.picture[10, 10], (220, 0, 0), atol=12)
        np.testing.assert_allclose(first.picture[10, -10], (0, 0, 220), atol=12)
        assert first.captured <= first.arrived <= CLOCK.now()
        until(lambda: camera.latest().captured > first.captured)  # type: ignore[union-attr]
        assert camera.health().why == ""


@both
def test_settings_shape_its_pictures(kind: str) -> None:
    with watched(kind, rotate=90, size=[60, 80], colours="bgr") as (_, camera):
        until(camera.latest)
        shot = camera.latest()
        assert shot is not None
        assert shot.picture.shape == (80, 60, 3)
        np.testing.assert_allclose(
            shot.picture[5, 30], (0, 0, 220), atol=12
        )  # red was on the left, is on top


def test_an_unknown_host_is_named() -> None:
    with looking(rtsp, "rtsp://no-such-host.invalid/x") as camera:
        until(lambda: camera.health().failed)
        assert camera.health().why == "the host no-such-host.invalid is not known"


def test_a_slow_camera_is_no_lost_one() -> None:
    with watched("mjpeg", read_s=2.0) as (server, camera):
        until(lambda: live(camera))
        server.rate = 4.0
        seen: set[float] = set()
        until(lambda: seen.add(camera.latest().captured) or len(seen) > 3)  # type: ignore[func-returns-value, union-attr]
        assert (camera.health().condition, camera.health().losses) == (CameraCondition.LIVE, 0)


def test_a_stream_whose_time_jumps_is_counted_and_its_pictures_stay_new() -> None:
    with watched("rtsp") as (server, camera):
        assert isinstance(server, RtspServer)
        until(lambda: live(camera))
        for count, offset in enumerate((100.0, 0.0), 1):
            server.stamp_offset = offset
            until(lambda count=count: camera.faults() == {"camera_clock_jumped_wrist": count})
            jumped = CLOCK.now()
            until(lambda jumped=jumped: camera.latest().captured > jumped)  # type: ignore[union-attr]
        assert camera.health().losses == 0


def test_a_mute_camera_does_not_keep_another_one_waiting_and_both_end() -> None:
    with watched("rtsp", "mute") as (_, mute), watched("mjpeg") as (_, playing):
        until(lambda: live(playing))
        assert mute.latest() is None
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
        assert (health.condition, health.losses) == (CameraCondition.LOST, 1)
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
