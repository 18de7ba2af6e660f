from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from runtime.cameras.base import Camera, CameraCondition, CameraHealth, CapturedImage
from runtime.cameras.source_with_cameras import SourceWithCameras
from runtime.core.clock import VirtualClock
from runtime.core.types import Observation
from runtime.ipc.messages import Event
from runtime.transports.base import Source

OURS = np.full((4, 4, 3), 7, np.uint8)
THEIRS = np.zeros((2, 2, 3), np.uint8)


class Robot(Source):
    """A transport that has pictures of two cameras, one of them ours by now."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.heard = clock, []
        self.silent = False
        self.told: list[Event] = []

    def connect(self) -> None:
        self.heard.append("connect")

    def receive(self, timeout: float) -> Observation | None:
        now = self.clock.now()
        pictures = {"wrist": THEIRS, "high": THEIRS}
        captured = dict.fromkeys(("joints", *pictures), now)
        return None if self.silent else Observation(1, now, captured, np.zeros(2, np.float32), pictures)

    def close(self) -> None:
        self.heard.append("close")

    def begin_run(self) -> None:
        self.heard.append("begin_run")

    def end_run(self) -> None:
        self.heard.append("end_run")

    def faults(self) -> dict[str, int]:
        return {"malformed": 1}

    def describe_fault(self, fault: str) -> str:
        return f"why {fault}"

    def pop_events(self) -> list[Event]:
        told, self.told = self.told, []
        return told


class Hand(Camera):
    """A camera under the test's hand."""

    key, kind, shown = "wrist", "rtsp", "rtsp://10.0.0.7/x"

    def __init__(self) -> None:
        self.heard: list[str] = []
        self.shot: CapturedImage | None = None
        self.how = CameraHealth(CameraCondition.OPENING, 100.0, "it is being opened")

    def start(self) -> None:
        self.heard.append("start")

    def latest(self) -> CapturedImage | None:
        return self.shot

    def health(self) -> CameraHealth:
        return self.how

    def request_stop(self) -> None:
        self.heard.append("leave")

    def close(self) -> None:
        self.heard.append("close")

    def begin_run(self) -> None:
        self.heard.append("begin_run")

    def end_run(self) -> None:
        self.heard.append("end_run")

    def faults(self) -> dict[str, int]:
        return {"camera_clock_jumped_wrist": 2}


class Bench:
    def __init__(self) -> None:
        self.clock = VirtualClock(100.0)
        self.robot, self.camera = Robot(self.clock), Hand()
        self.source = SourceWithCameras(self.robot, [self.camera], self.clock)

    def seen(self) -> Observation:
        observation = self.source.receive(0.0)
        assert observation is not None
        return observation

    def told(self) -> list[tuple[str, str]]:
        return [(event.kind, event.text) for event in self.source.pop_events()]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_picture_of_ours_joins_the_observation_with_its_own_time_and_leaves_the_others(
    bench: Bench,
) -> None:
    bench.camera.shot = CapturedImage(OURS, 99.9, 99.95)
    seen = bench.seen()
    assert seen.pictures["wrist"] is OURS
    assert seen.pictures["high"] is THEIRS
    assert dict(seen.captured) == {"joints": 100.0, "wrist": 99.9, "high": 100.0}


def test_before_its_first_picture_a_camera_is_missing_even_where_the_transport_has_one(bench: Bench) -> None:
    seen = bench.seen()
    assert set(seen.pictures) == {"high"}
    assert set(seen.captured) == {"joints", "high"}


def test_a_picture_that_stays_keeps_its_time_and_grows_old(bench: Bench) -> None:
    bench.camera.shot = CapturedImage(OURS, 99.9, 99.95)
    bench.clock.advance(3.0)
    assert bench.seen().captured["wrist"] == 99.9
    assert bench.source.camera_health()["wrist"]["age"] == pytest.approx(3.1)


def test_pictures_alone_are_no_observation(bench: Bench) -> None:
    bench.camera.shot = CapturedImage(OURS, 99.9, 99.95)
    bench.robot.silent = True
    assert bench.source.receive(0.0) is None


def test_both_hear_of_connection_runs_and_end(bench: Bench) -> None:
    for call in ("connect", "begin_run", "end_run", "close"):
        getattr(bench.source, call)()
    assert bench.robot.heard == ["connect", "begin_run", "end_run", "close"]
    assert bench.camera.heard == ["start", "begin_run", "end_run", "leave", "close"]
    assert bench.source.faults() == {"malformed": 1, "camera_clock_jumped_wrist": 2}


def test_what_the_robots_own_link_says_is_said_too(bench: Bench) -> None:
    bench.robot.told = [Event("source_waiting", "waiting for the node", 100.0)]
    assert bench.told() == [("source_waiting", "waiting for the node")]
    assert bench.told() == []
    assert bench.source.describe_fault("malformed") == "why malformed"


def test_that_a_camera_is_a_video_is_said_once(bench: Bench) -> None:
    bench.camera.kind, bench.camera.shown = "file", "a.mp4"
    text = "camera wrist plays the video a.mp4: it does not show what is there"
    assert bench.told() == [("camera_is_a_video", text)]
    bench.camera.how = CameraHealth(CameraCondition.LIVE, 101.0)
    assert [kind for kind, _ in bench.told()] == ["camera_back"]


def test_what_happens_to_a_camera_is_said_once_with_which_why_and_since_when(bench: Bench) -> None:
    camera = bench.camera
    assert bench.told() == [], "it is being opened"
    camera.how = CameraHealth(CameraCondition.OPENING, 100.0, "refused", failed=True)
    assert bench.told() == [("camera_absent", "camera wrist (rtsp://10.0.0.7/x): refused")]
    assert bench.told() == []
    camera.how = CameraHealth(CameraCondition.LIVE, 102.5)
    assert bench.told() == [("camera_back", "camera wrist (rtsp://10.0.0.7/x) gives pictures after 2.5 s")]
    camera.how, camera.shot = (
        CameraHealth(CameraCondition.LOST, 110.0, "mute", 1, failed=True),
        CapturedImage(OURS, 109.0, 109.0),
    )
    bench.clock.advance(11.0)
    (event,) = bench.source.pop_events()
    assert (event.kind, event.text) == ("camera_lost", "camera wrist (rtsp://10.0.0.7/x) is lost: mute")
    assert dict(event.data) == {
        "camera": "wrist",
        "kind": "rtsp",
        "source": "rtsp://10.0.0.7/x",
        "condition": "lost",
        "since": 110.0,
        "why": "mute",
        "losses": 1,
        "age": pytest.approx(2.0),
    }
    camera.how = replace(camera.how, why="refused")
    assert bench.told() == [("camera_lost", "camera wrist (rtsp://10.0.0.7/x) is lost: refused")]
    camera.how = CameraHealth(CameraCondition.ENDED, 112.0, "the file is over")
    assert bench.told()[0][0] == "camera_ended"
