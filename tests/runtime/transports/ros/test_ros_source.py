"""The source on messages that are handed to it, with a clock that only the test moves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.clock import VirtualClock
from runtime.core.errors import ConfigurationError, TransportError
from runtime.core.types import Observation
from runtime.transports import ros2
from runtime.transports.ros import cdr
from runtime.transports.ros.messages import Image, JointState, Message, PoseStamped
from runtime.transports.ros.middleware import Match
from runtime.transports.ros.source import RosSource
from runtime.transports.ros.topics import GroupTopics, Topics
from tests.runtime.transports.ros.hand import FakeMiddleware

ROBOT = robots.load_robot("ur5e")
NAMES = ROBOT.groups[0].joints
TOPICS = Topics(
    cameras={"wrist_image": "/wrist", "exterior_image": "/high"},
    groups={"arm": GroupTopics(state="/state", command="/command", eef="/pose")},
)
WALL = 1_800_000_000.0


class Bench:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> None:
        self.hand, self.clock = FakeMiddleware(), VirtualClock(50.0)
        monkeypatch.setattr(ros2, "middleware", lambda *_: self.hand)
        config = ros2.Config(topics=settings.pop("topics", TOPICS), **settings)
        self.source: RosSource = ros2.source(config, ROBOT, self.clock)
        self.source.connect()
        self.mark = 0

    def say(self, topic: str, message: Message) -> None:
        self.hand.deliver[topic](cdr.encode(message))

    def joints(self, stamp: float, first: float = 0.0, names: tuple[str, ...] = NAMES) -> None:
        position = np.arange(7.0)
        position[0] = first
        self.say("/state", JointState(nanoseconds(stamp), "", names, position))

    def picture(self, topic: str, stamp: float, encoding: str = "bgr8") -> None:
        self.mark += 1
        pixels = np.zeros((4, 6, 3), np.uint8)
        pixels[..., 0], pixels[..., 1] = 200, self.mark
        self.say(topic, Image(nanoseconds(stamp), "", 4, 6, encoding, 18, pixels.reshape(-1)))

    def frame(self, stamp: float, **more: Any) -> None:
        self.joints(stamp, **more)
        self.picture("/wrist", stamp)
        self.picture("/high", stamp)

    def seen(self) -> Observation:
        found = self.source.receive(0.0)
        assert found is not None
        return found

    def news(self) -> list[str]:
        return [event.text for event in self.source.pop_events()]


def nanoseconds(stamp: float) -> int:
    return round((WALL + stamp) * 1e9)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_a_whole_frame_is_an_observation(bench: Bench) -> None:
    bench.frame(0.0, first=0.5)
    seen = bench.seen()
    assert seen.sequence == 1
    assert seen.qpos.tolist() == [0.5, 1, 2, 3, 4, 5, 6]
    assert seen.pictures["cam_wrist"][0, 0].tolist() == [0, 1, 200]
    assert dict(seen.captured) == {"joints": 50.0, "cam_wrist": 50.0, "cam_high": 50.0}
    assert seen.arrived == 50.0
    assert (seen.qvel, seen.effort, seen.eef) == (None, None, None)
    assert bench.source.receive(0.0) is None


def test_times_are_the_messages_own_on_our_clock(bench: Bench) -> None:
    bench.frame(0.0)
    bench.seen()
    bench.clock.advance(0.1)
    bench.joints(0.1)
    bench.clock.advance(0.05)  # pictures take 50 ms longer
    bench.picture("/wrist", 0.08)
    bench.picture("/high", 0.1)
    seen = bench.seen()
    assert seen.captured["joints"] == pytest.approx(50.1)
    assert seen.captured["cam_wrist"] == pytest.approx(50.08)
    assert seen.arrived == pytest.approx(50.15)


def test_it_waits_rather_than_deliver_what_does_not_belong_together(bench: Bench) -> None:
    bench.joints(0.0)
    bench.picture("/wrist", 0.0)
    bench.picture("/high", 0.5)
    assert bench.source.receive(0.0) is None
    bench.joints(0.5)
    assert bench.source.receive(0.0) is None
    bench.picture("/wrist", 0.45)
    assert {round(time - 50, 2) for time in bench.seen().captured.values()} <= {0.0, -0.05}


def test_other_readers_see_the_same(bench: Bench) -> None:
    bench.frame(0.0)
    first = bench.source.alignment.frame()
    bench.seen()
    assert bench.source.alignment.frame() == first


def test_a_stalled_stream_is_named_with_its_age_and_only_once(bench: Bench) -> None:
    bench.frame(0.0)
    bench.seen()
    bench.hand.found = {"/high": Match(1)}
    for tick in range(1, 21):
        bench.clock.advance(0.1)
        bench.joints(tick / 10)
        bench.picture("/wrist", tick / 10)
        assert bench.source.receive(0.0) is None
    assert bench.source.stalled() == {"cam_high": pytest.approx(2.0)}
    assert bench.news() == ["waiting for cam_high (/high): nothing for 0.5 s"]
    assert bench.source.faults() == {"stalled_cam_high": 1}
    bench.picture("/high", 2.0)
    bench.seen()
    assert bench.source.stalled() == {}
    assert bench.source.faults() == {"stalled_cam_high": 1}
    bench.clock.advance(0.7)
    bench.joints(2.7)
    bench.picture("/wrist", 2.7)
    assert bench.source.receive(0.0) is None
    assert bench.source.faults() == {"stalled_cam_high": 2}
    assert bench.news() == ["waiting for cam_high (/high): nothing for 0.7 s"]


def test_who_is_at_the_other_side_is_said_with_it(bench: Bench) -> None:
    refusal = "a publisher of /high is incompatible in its reliability: and so on"
    bench.hand.found = {"/high": Match(0, refusal), "/wrist": Match(0), "/state": Match(1)}
    bench.clock.advance(1.0)
    assert bench.source.receive(0.0) is None
    assert bench.news() == []  # all may still find each other
    bench.clock.advance(1.0)
    assert bench.source.receive(0.0) is None
    assert bench.news() == [
        "waiting for cam_wrist (/wrist): nothing for 2.0 s: no publisher; waiting for cam_high (/high): "
        f"nothing for 2.0 s: {refusal}; waiting for arm joints (/state): nothing for 2.0 s"
    ]


def test_what_all_have_in_common_is_said_once(bench: Bench) -> None:
    bench.hand.found = {topic: Match(0, "no master is there") for topic in ("/high", "/wrist", "/state")}
    bench.clock.advance(2.0)
    assert bench.source.receive(0.0) is None
    assert bench.news() == ["waiting for cam_wrist, cam_high, arm joints: no master is there"]


def test_a_cause_that_is_found_later_is_told_later_and_once(bench: Bench) -> None:
    bench.hand.found = {"/high": Match(0), "/wrist": Match(1), "/state": Match(1)}
    bench.clock.advance(2.0)
    assert bench.source.receive(0.0) is None
    assert "(/high): nothing for 2.0 s: no publisher" in " ".join(bench.news())
    bench.hand.found["/high"] = Match(0, "/high is published as something else")
    for _ in range(20):
        bench.clock.advance(0.1)
        assert bench.source.receive(0.0) is None
    (said,) = bench.news()
    assert said.startswith("waiting for cam_high (/high): nothing for ")
    assert said.endswith(": /high is published as something else")


def test_wrong_names_are_counted_and_named_as_the_reason(bench: Bench) -> None:
    for tick in range(20):
        bench.clock.advance(0.1)
        bench.joints(tick / 10, names=("x", *NAMES[1:]))
        bench.picture("/wrist", tick / 10)
        bench.picture("/high", tick / 10)
        assert bench.source.receive(0.0) is None
    faults = bench.source.faults()
    assert faults["joint_names"] == 20
    (said,) = bench.news()
    assert said.startswith("waiting for arm joints (/state): nothing usable for ")
    assert f"lack {NAMES[0]}; expected {NAMES[0]}" in said
    assert bench.source.describe_fault("joint_names") != ""


def test_an_unknown_encoding_is_counted_and_named(bench: Bench) -> None:
    bench.joints(0.0)
    bench.picture("/high", 0.0)
    bench.picture("/wrist", 0.0, encoding="yuv422")
    bench.clock.advance(2.0)
    assert bench.source.receive(0.0) is None
    assert bench.source.faults()["wrong_encoding"] == 1
    assert "'yuv422'; allowed: bgr8" in " ".join(bench.news())


def test_bytes_that_are_no_message_end_nothing(bench: Bench) -> None:
    for garbage in (b"", b"\x00\x01\x00\x00", b"\xff" * 40):
        bench.hand.deliver["/state"](garbage)
    assert bench.source.faults() == {"malformed": 3}
    bench.frame(0.0)
    bench.seen()


def test_messages_without_a_stamp_are_refused_unless_arrivals_count(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    bench.frame(-WALL)
    assert bench.source.faults()["unstamped"] == 3
    assert 'transport.stamps = "arrival"' in bench.source.describe_fault("unstamped")
    bench = Bench(monkeypatch, stamps="arrival")
    bench.frame(-WALL)
    assert set(bench.seen().captured.values()) == {50.0}


def test_a_clock_that_goes_back_begins_anew_at_once(bench: Bench) -> None:
    bench.frame(1000.0)
    bench.seen()
    bench.clock.advance(0.1)
    bench.frame(0.0)
    seen = bench.seen()
    assert list(seen.captured.values()) == pytest.approx([50.1] * 3, abs=1e-6)
    assert bench.source.faults()["clock_backwards"] >= 1


def test_stamps_that_do_not_advance_are_no_news(bench: Bench) -> None:
    bench.frame(0.0)
    bench.seen()
    for tick in range(1, 10):
        bench.clock.advance(0.1)
        bench.joints(0.0)
        bench.picture("/wrist", tick / 10)
        bench.picture("/high", tick / 10)
        assert bench.source.receive(0.0) is None
    assert bench.source.faults()["not_newer"] == 9
    assert "arm joints (/state): nothing usable for 0.5 s: its stamps do not advance" in " ".join(
        bench.news()
    )


def test_computers_with_different_clocks_are_named(bench: Bench) -> None:
    for tick in range(20):
        bench.clock.advance(0.1)
        bench.joints(tick / 10)
        bench.picture("/wrist", tick / 10)
        bench.picture("/high", tick / 10 - 5)
        assert bench.source.receive(0.0) is None
    (said,) = bench.news()
    assert said.startswith(
        "no message of cam_wrist, arm joints is within 0.1 s of the newest of cam_high, whose "
    )
    assert "5.00 s behind the others'" in said


def test_a_picture_that_stays_the_same_is_old(bench: Bench) -> None:
    for tick in range(10):
        bench.clock.advance(0.1)
        bench.joints(tick / 10)
        bench.picture("/high", tick / 10)
        pixels = np.full(72, 9, np.uint8)
        bench.say("/wrist", Image(nanoseconds(tick / 10), "", 4, 6, "rgb8", 18, pixels))
        seen = bench.seen()
    assert seen.captured["cam_high"] - seen.captured["cam_wrist"] == pytest.approx(0.9)
    assert bench.source.faults()["frozen_cam_wrist"] == 1


def test_poses_come_with_grippers_of_the_joints(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, eef=True)
    bench.frame(0.0)
    assert bench.source.receive(0.0) is None  # frames wait for poses too
    bench.say("/pose", PoseStamped(nanoseconds(0.0), "", np.array([0.1, 0.2, 0.3, 0, 0, 0, 1])))
    seen = bench.seen()
    assert seen.eef is not None
    np.testing.assert_allclose(seen.eef, [0.1, 0.2, 0.3, 1, 0, 0, 0, 6], rtol=1e-6)
    assert "eef" in seen.captured


def test_velocities_are_those_of_the_robot_where_all_are_known(bench: Bench) -> None:
    bench.frame(0.0)
    bench.seen()
    numbers = np.arange(7.0)
    bench.say("/state", JointState(nanoseconds(0.2), "", NAMES[::-1], numbers, numbers * 2, numbers[:3]))
    bench.picture("/wrist", 0.2)
    bench.picture("/high", 0.2)
    seen = bench.seen()
    assert seen.qpos.tolist() == [6, 5, 4, 3, 2, 1, 0]
    assert seen.qvel is not None
    assert seen.qvel.tolist() == [12, 10, 8, 6, 4, 2, 0]
    assert seen.effort is None


def test_a_source_that_is_not_connected_says_so(bench: Bench) -> None:
    bench.source.close()
    bench.source.close()
    assert bench.hand.closed
    with pytest.raises(TransportError, match="connect before receiving"):
        bench.source.receive(0.0)


def test_a_topic_has_one_type_of_message(monkeypatch: pytest.MonkeyPatch) -> None:
    topics = TOPICS.model_copy(update={"cameras": {"wrist_image": "/state", "exterior_image": "/high"}})
    with pytest.raises(
        ConfigurationError, match="/state is the topic of cam_wrist, arm joints, which are Image and"
    ):
        Bench(monkeypatch, topics=topics)
