"""ROS 2 as a deployment has it, against a simulated robot in a process of its own, over loopback UDP."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.types import Observation, RobotCommand
from runtime.transports import ros2
from runtime.transports.ros import rclpy_middleware
from runtime.transports.ros.middleware import Quality
from runtime.transports.ros.source import RosSource
from runtime.transports.ros.topics import GroupTopics, Topics
from tests.processes import PATIENCE_S, eventually

ROBOT = robots.load_robot("r1_lite")
HEAD = "/hdas/camera_head/right_raw/image_raw_color/compressed"
LEFT = "/hdas/feedback_arm_left"

Node = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def node(domain: int) -> Iterator[Node]:
    """Starts a simulated robot; ends it with the test."""
    pytest.importorskip("cyclonedds", reason="the package cyclonedds (extra ros2) is not installed")
    running: list[subprocess.Popen[bytes]] = []

    def begin(*arguments: str) -> subprocess.Popen[bytes]:
        line = [
            "--robot",
            "r1_lite",
            "--domain",
            str(domain),
            "--width",
            "64",
            "--height",
            "48",
            "--lifeline",
        ]
        process = subprocess.Popen(
            [sys.executable, "-m", "runtime.simulation.ros2_node", *line, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        running.append(process)
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["domain"] == domain
        return process

    yield begin
    for process in running:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> str:
    """Close its lifeline; returns what it said last."""
    assert process.stdin is not None
    assert process.stdout is not None
    if process.stdin.closed:
        return ""
    process.stdin.close()
    said = process.stdout.read().decode()
    process.wait(PATIENCE_S)
    process.stdout.close()
    return said


@contextlib.contextmanager
def listening(domain: int, **settings: Any) -> Iterator[RosSource]:
    source = ros2.source(ros2.Config(domain=domain, **settings), ROBOT, MonotonicClock())
    source.connect()
    with contextlib.closing(source):
        yield source


def seen(source: RosSource) -> Observation:
    return eventually(lambda: source.receive(0.1), "an observation")


def said(source: RosSource, *words: str) -> str:
    """The sentence among the news that has all these words."""

    def found() -> str:
        assert source.receive(0.05) is None
        return next((e.text for e in source.pop_events() if all(word in e.text for word in words)), "")

    return eventually(found, f"news with {words}")


def test_observations_come_and_commands_arrive(domain: int, node: Node) -> None:
    process = node()
    goal = ROBOT.poses["ready"].astype(np.float32)
    with listening(domain) as source:
        first = seen(source)
        assert np.allclose(
            first.qpos, ROBOT.poses["home"], atol=1e-4
        )  # in order, whatever that of the messages
        assert set(first.captured) == {"joints", "cam_high", "cam_left_wrist", "cam_right_wrist"}
        assert all(0 <= time.monotonic() - at < PATIENCE_S for at in first.captured.values())
        sink = ros2.sink(ros2.Config(domain=domain), ROBOT, MonotonicClock())
        sink.connect()
        with contextlib.closing(sink):

            def arrived() -> bool:
                sink.send(RobotCommand(goal, 0, time.monotonic()))
                newest = source.receive(0.05)
                return newest is not None and bool(np.allclose(newest.qpos, goal, atol=0.01))

            eventually(arrived, "the goal")
            assert sink.missing_subscribers() == {}
    assert json.loads(_end(process).splitlines()[-1])["refused"] == 0


@pytest.mark.exhaustive
def test_a_robot_that_starts_again_is_seen_again(domain: int, node: Node) -> None:
    first = node()
    with listening(domain) as source:
        seen(source)
        first.kill()
        first.wait(PATIENCE_S)
        eventually(lambda: source.receive(0.2) is None, "the end of what was on its way")
        said(source, "waiting for", f"left_arm joints ({LEFT}): nothing for")
        node()
        assert seen(source).sequence < seen(source).sequence


@pytest.mark.exhaustive
def test_a_topic_that_falls_silent_is_named_and_nothing_is_delivered(domain: int, node: Node) -> None:
    node("--silence", HEAD, "--silence-from", "45")
    with listening(domain) as source:
        seen(source)

        def stalled() -> str:
            source.receive(0.05)
            return next((e.text for e in source.pop_events() if "cam_high" in e.text), "")

        sentence = eventually(stalled, "the silence of cam_high")
        assert sentence.startswith(f"waiting for cam_high ({HEAD}): nothing for ")
        assert source.receive(0.3) is None
        assert source.faults()["stalled_cam_high"] >= 1


@pytest.mark.exhaustive
def test_joints_of_other_names_are_refused_by_name(domain: int, node: Node) -> None:
    node("--wrong-names")
    with listening(domain) as source:
        sentence = said(source, "left_arm joints", "nothing usable")
        assert "lack left_arm_joint1" in sentence
        assert source.faults()["joint_names"] > 0
    topics = {
        "groups": {
            group.name: GroupTopics(joints=[f"x_{joint}" for joint in group.joints]) for group in ROBOT.groups
        }
    }
    with listening(domain, topics=Topics(**topics)) as source:
        assert np.allclose(seen(source).qpos, ROBOT.poses["home"], atol=1e-4)


@pytest.mark.exhaustive
def test_pictures_of_another_type_are_named(domain: int, node: Node) -> None:
    node("--other-pictures")
    with listening(domain) as source:
        sentence = said(source, "cam_high")
    assert (
        f"{HEAD} is published as sensor_msgs/msg/Image; expected sensor_msgs/msg/CompressedImage" in sentence
    )


@pytest.mark.exhaustive
def test_a_quality_that_the_robot_does_not_offer_is_named(domain: int, node: Node) -> None:
    node()
    with listening(domain, qos={HEAD: Quality(reliability="reliable")}) as source:
        sentence = said(source, "cam_high")
    assert f"a publisher of {HEAD} is incompatible in its reliability" in sentence


@pytest.mark.exhaustive
def test_a_clock_far_from_ours_ages_nothing(domain: int, node: Node) -> None:
    node("--clock-offset", "-86400")
    with listening(domain) as source:
        seen(source)
        newest = seen(source)
        assert all(0 <= newest.arrived - at < 5 for at in newest.captured.values())
        assert source.faults().get("clock_backwards", 0) == 0


def test_it_leaves_this_machine_only_where_that_is_asked_for() -> None:
    for given in ({"network": "eth0"}, {"network": "environment"}, {"middleware": "rclpy"}):
        with pytest.raises(ConfigurationError, match="may leave this machine without protection; allowed: "):
            ros2.Config(**given)
        ros2.Config(**given, insecure_link=True)
    with pytest.raises(ConfigurationError, match="peers = "):
        ros2.Config(peers=["10.0.0.7"])
    with pytest.raises(ConfigurationError, match="is no interface or address"):
        ros2.Config(network="eth0'/>", insecure_link=True)
    with pytest.raises(ValidationError):
        ros2.Config(domain=233)


def test_commands_are_not_kept_for_robots_that_come_later() -> None:
    kept = {"/motion_target/target_joint_state_arm_left": Quality(durability="transient_local")}
    with pytest.raises(ConfigurationError, match="a robot that starts would obey an old command"):
        ros2.cameras(ros2.Config(qos=kept), ROBOT)


def test_a_quality_of_a_topic_that_is_none_is_refused() -> None:
    with pytest.raises(
        ConfigurationError, match=r"qos: /nothing are no topics of this deployment; allowed: /hdas"
    ):
        ros2.cameras(ros2.Config(qos={"/nothing": Quality()}), ROBOT)


def test_a_target_is_named_once() -> None:
    with pytest.raises(ConfigurationError, match="each at most once"):
        ros2.Config(commands_to=["robot", "robot"])


def test_cameras_are_those_that_are_not_disabled() -> None:
    assert ros2.cameras(ros2.Config(disabled_cameras=["cam_high"]), ROBOT) == (
        "cam_left_wrist",
        "cam_right_wrist",
    )


def test_what_it_can_do_is_declared() -> None:
    pytest.importorskip("cyclonedds", reason="the package cyclonedds (extra ros2) is not installed")
    plain = ros2.capabilities(ros2.Config())
    assert (plain.moves_robot, plain.measures_eef, plain.spaces) == (True, False, {"joint"})
    posed = ros2.capabilities(ros2.Config(eef=True, eef_commands=True))
    assert (posed.measures_eef, posed.spaces) == (True, {"joint", "eef"})


def test_an_absent_middleware_is_an_error_that_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "runtime.transports.ros.idl", None)
    with pytest.raises(SetupError, match=r'needs the package cyclonedds .*pip install "eva-web\[ros2\]"'):
        ros2.capabilities(ros2.Config())
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(
        SetupError, match=r"needs a ROS 2 installation for Python 3\.\d+ .*source its setup\.bash"
    ):
        ros2.capabilities(ros2.Config(middleware="rclpy", insecure_link=True))
    with pytest.raises(SetupError, match="source its"):
        rclpy_middleware.RclMiddleware(0, "eva_web")
