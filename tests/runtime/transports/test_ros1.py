"""ROS 1 as a deployment has it, against a simulated robot on rospy in a process of its own, over a real master."""

from __future__ import annotations

import contextlib
import json
import logging
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
from runtime.transports import ros1
from runtime.transports.ros.source import RosSource
from runtime.transports.ros.topics import GroupTopics, Topics
from tests.processes import PATIENCE_S, eventually
from tests.runtime.ros_master import RosMaster, needs_ros1

ROBOT = robots.load_robot("agilex_piper")
HEAD, LEFT = "/camera_f/color/image_raw", "/puppet/joint_left"
READY = ROBOT.poses["ready"].astype(np.float32)

Node = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def node(ros_master: RosMaster) -> Iterator[Node]:
    """Starts a simulated robot; ends it with the test."""
    running: list[subprocess.Popen[bytes]] = []

    def begin(*arguments: str, robot: str = "agilex_piper") -> subprocess.Popen[bytes]:
        line = ["--robot", robot, "--master", ros_master.uri, "--width", "64", "--height", "48", "--lifeline"]
        process = subprocess.Popen(
            [sys.executable, "-m", "runtime.simulation.ros1_node", *line, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        running.append(process)
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["master"] == ros_master.uri
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
def listening(ros: RosMaster, robot: robots.Robot = ROBOT, **settings: Any) -> Iterator[RosSource]:
    source = ros1.source(ros1.Config(master=ros.uri, **settings), robot, MonotonicClock())
    source.connect()
    with contextlib.closing(source):
        yield source


def seen(source: RosSource) -> Observation:
    return eventually(lambda: source.receive(0.1), "an observation")


def said(source: RosSource, *words: str) -> str:
    """The sentence among the news that has all these words."""

    def found() -> str:
        source.receive(0.05)
        return next((e.text for e in source.pop_events() if all(word in e.text for word in words)), "")

    return eventually(found, f"news with {words}")


def led(ros: RosMaster, source: RosSource, goal: np.ndarray, **settings: Any) -> None:
    """Command the goal until the robot is there."""
    sink = ros1.sink(ros1.Config(master=ros.uri, **settings), ROBOT, MonotonicClock())
    sink.connect()
    with contextlib.closing(sink):

        def arrived() -> bool:
            sink.send(RobotCommand(goal, 0, time.monotonic()))
            newest = source.receive(0.05)
            return newest is not None and bool(np.allclose(newest.qpos, goal, atol=0.01))

        eventually(arrived, "the goal")


@needs_ros1
def test_observations_come_and_commands_arrive(ros_master: RosMaster, node: Node) -> None:
    process = node()
    with listening(ros_master, eef=True) as source:
        first = seen(source)
        assert np.allclose(first.qpos, ROBOT.poses["home"], atol=1e-4)  # whatever the order of the messages
        assert set(first.captured) == {"joints", "eef", "cam_high", "cam_left_wrist", "cam_right_wrist"}
        assert {picture.shape for picture in first.pictures.values()} == {(48, 64, 3)}
        assert all(0 <= time.monotonic() - at < PATIENCE_S for at in first.captured.values())
        led(ros_master, source, READY)
        there = seen(source)
        assert there.eef is not None
        poses = np.concatenate([arm.pose(there.qpos) for arm in ROBOT.arms])
        np.testing.assert_allclose(there.eef.reshape(2, 8)[:, :7].reshape(-1), poses, atol=1e-4)
    assert json.loads(_end(process).splitlines()[-1])["refused"] == 0


@pytest.mark.exhaustive
@needs_ros1
def test_a_robot_without_topics_of_its_own_has_compressed_pictures_and_those_of_the_deployment(
    ros_master: RosMaster, node: Node
) -> None:
    robot = robots.load_robot("ur5e")
    node(robot="ur5e")
    topics = Topics(
        cameras={"exterior_image": "/exterior_image/image_raw/compressed"},
        groups={"arm": GroupTopics(state="/arm/joint_states", command="/arm/command")},
    )
    with listening(ros_master, robot, topics=topics, disabled_cameras=["cam_wrist"]) as source:
        first = seen(source)
    assert set(first.pictures) == {"cam_high"}
    assert np.allclose(first.qpos, robot.poses["home"], atol=1e-4)


@pytest.mark.exhaustive
@needs_ros1
def test_grippers_with_topics_of_their_own_are_split_off_and_put_together(
    ros_master: RosMaster, node: Node
) -> None:
    robot = robots.load_robot("r1_lite")  # a robot of ROS 2, whose drivers have grippers apart
    assert robot.ros is not None
    groups = {
        name: GroupTopics(
            **{
                field: getattr(own, field)
                for field in ("state", "command", "gripper_state", "gripper_command")
            }
        )
        for name, own in robot.ros.groups.items()
    }
    cameras = dict(robot.ros.cameras)
    topics = Topics(cameras=cameras, groups=groups)
    process = node("--topics-of", "2", robot="r1_lite")
    goal = robot.poses["ready"].astype(np.float32)
    with listening(ros_master, robot, topics=topics) as source:
        assert np.allclose(seen(source).qpos, robot.poses["home"], atol=1e-4)
        sink = ros1.sink(ros1.Config(master=ros_master.uri, topics=topics), robot, MonotonicClock())
        sink.connect()
        with contextlib.closing(sink):

            def arrived() -> bool:
                sink.send(RobotCommand(goal, 0, time.monotonic()))
                newest = source.receive(0.05)
                return newest is not None and bool(np.allclose(newest.qpos, goal, atol=0.01))

            eventually(arrived, "the goal")
    assert json.loads(_end(process).splitlines()[-1])["refused"] == 0


@pytest.mark.exhaustive
@needs_ros1
def test_a_group_and_a_camera_that_a_deployment_leaves_out_have_no_topics(
    ros_master: RosMaster, node: Node
) -> None:
    node("--groups", "left_arm")
    robot = robots.load_robot("agilex_piper", ["left_arm"])
    with listening(ros_master, robot, disabled_cameras=["cam_high"]) as source:
        first = seen(source)
    assert first.qpos.shape == (7,)
    assert set(first.pictures) == {"cam_left_wrist", "cam_right_wrist"}


@pytest.mark.exhaustive
@needs_ros1
def test_a_simulation_beside_the_robot_is_told_the_same(ros_master: RosMaster, node: Node) -> None:
    node("--as-simulation")
    with listening(ros_master) as source:
        seen(source)
        led(ros_master, source, READY, commands_to=["robot", "simulation"])


@pytest.mark.exhaustive
@needs_ros1
def test_a_robot_that_starts_again_is_seen_again(ros_master: RosMaster, node: Node) -> None:
    first = node()
    with listening(ros_master) as source:
        seen(source)
        first.kill()
        first.wait(PATIENCE_S)
        said(source, "waiting for", f"left_arm joints ({LEFT}): nothing for")
        node()
        seen(source)
        assert source.receive(1.0) is not None


@pytest.mark.exhaustive
@needs_ros1
def test_a_topic_that_falls_silent_is_named_and_nothing_is_delivered(
    ros_master: RosMaster, node: Node
) -> None:
    node("--silence", HEAD, "--silence-from", "200")
    with listening(ros_master) as source:
        seen(source)
        source.pop_events()  # of the time before all were there
        assert f"waiting for cam_high ({HEAD}): nothing for " in said(source, "cam_high")
        # A busy machine may have been silent before, and goes on after that; the topic does not.
        eventually(
            lambda: source.receive(0.05) is None and source.stalled().get("cam_high", 0) > 3,
            "silence",
        )
        assert source.receive(0.3) is None
        assert source.faults()["stalled_cam_high"] >= 1


@pytest.mark.exhaustive
@needs_ros1
def test_joints_of_other_names_are_refused_by_name(ros_master: RosMaster, node: Node) -> None:
    node("--wrong-names")
    with listening(ros_master) as source:
        sentence = said(source, "left_arm joints", "nothing usable")
        assert "lack joint0" in sentence
        assert source.faults()["joint_names"] > 0
    named = {g.name: GroupTopics(joints=[f"x_{joint}" for joint in g.joints]) for g in ROBOT.groups}
    with listening(ros_master, topics=Topics(groups=named)) as source:
        assert np.allclose(seen(source).qpos, ROBOT.poses["home"], atol=1e-4)


@pytest.mark.exhaustive
@needs_ros1
def test_pictures_of_another_type_and_of_unknown_colours_are_named(ros_master: RosMaster, node: Node) -> None:
    first = node("--other-pictures")
    with listening(ros_master) as source:
        sentence = said(source, "cam_high", "is published as")
    expected = f"{HEAD} is published as sensor_msgs/CompressedImage by /sim_robot; expected sensor_msgs/Image"
    assert expected in sentence
    _end(first)
    node("--encoding", "yuv422")
    with listening(ros_master) as source:
        assert "'yuv422'; allowed: bgr8" in said(source, "cam_high", "nothing usable")


@pytest.mark.exhaustive
@needs_ros1
def test_a_clock_far_from_ours_ages_nothing(ros_master: RosMaster, node: Node) -> None:
    node("--clock-offset", "-86400")
    with listening(ros_master) as source:
        seen(source)
        newest = seen(source)
        assert all(0 <= newest.arrived - at < 5 for at in newest.captured.values())
        assert source.faults().get("clock_backwards", 0) == 0


@needs_ros1
def test_nobody_at_the_topics_is_said(ros_master: RosMaster, caplog: pytest.LogCaptureFixture) -> None:
    with listening(ros_master) as source:
        assert f"left_arm joints ({LEFT}): nothing for" in said(source, "no publisher")
    sink = ros1.sink(ros1.Config(master=ros_master.uri), ROBOT, MonotonicClock())
    sink.connect()
    with contextlib.closing(sink):
        unheard = dict.fromkeys(("/puppet/master_joint_left", "/puppet/master_joint_right"), "")
        eventually(lambda: sink.missing_subscribers() == unheard, "nobody who listens")


@needs_ros1
def test_logging_and_signals_stay_ours(ros_master: RosMaster) -> None:
    before = logging.getLogger().handlers[:], logging.getLoggerClass(), logging.getLogger().level
    with listening(ros_master) as source:
        source.receive(0.1)
    after = logging.getLogger().handlers[:], logging.getLoggerClass(), logging.getLogger().level
    assert before == after
    assert "rospy" not in sys.modules


@needs_ros1
def test_a_master_that_is_not_there_is_named_for_all_topics_at_once() -> None:
    source = ros1.source(ros1.Config(master="http://127.0.0.1:9"), ROBOT, MonotonicClock())
    source.connect()
    with contextlib.closing(source):
        sentence = said(source, "no ROS master")
    assert sentence.startswith(
        "waiting for cam_high, cam_left_wrist, cam_right_wrist, left_arm joints, right_arm"
    )
    assert (
        sentence.count("no ROS master is to be reached at http://127.0.0.1:9: Connection refused; start") == 1
    )


@needs_ros1
def test_what_it_can_do_is_declared() -> None:
    plain = ros1.capabilities(ros1.Config())
    assert (plain.moves_robot, plain.measures_eef, plain.spaces) == (True, False, {"joint"})
    posed = ros1.capabilities(ros1.Config(eef=True, eef_commands=True))
    assert (posed.measures_eef, posed.spaces) == (True, {"joint", "eef"})


def test_absent_rospy_is_an_error_that_says_what_to_install() -> None:
    with pytest.raises(SetupError, match="apt-get install python3-rospy python3-sensor-msgs"):
        ros1.capabilities(ros1.Config(python=sys.executable))


def test_it_leaves_this_machine_only_where_that_is_asked_for() -> None:
    robot = {"master": "http://10.0.0.7:11311", "address": "10.0.0.2"}
    with pytest.raises(ConfigurationError, match=r"master = 'http://10\.0\.0\.7:11311' leaves this machine"):
        ros1.Config(**robot)
    with pytest.raises(ConfigurationError, match=r"address = '10\.0\.0\.2' leaves this machine"):
        ros1.Config(address="10.0.0.2")
    ros1.Config(**robot, insecure_link=True)
    ros1.Config(master="http://localhost:11311/")
    with pytest.raises(ConfigurationError, match="the robot's nodes do not reach this machine there"):
        ros1.Config(master="http://robot:11311", insecure_link=True)


@pytest.mark.parametrize(
    "master",
    ["10.0.0.7:11311", "https://robot:11311", "http://robot", "http://robot:0x1", "http://a b:11311", ""],
)
def test_a_master_that_is_no_address_is_refused(master: str) -> None:
    with pytest.raises(ConfigurationError, match="is no ROS_MASTER_URI; allowed: one like http://"):
        ros1.Config(master=master, address="10.0.0.2", insecure_link=True)


def test_an_address_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="address = 'robot' is no IP address"):
        ros1.Config(address="robot")
    with pytest.raises(ValidationError):
        ros1.Config(python="")


def test_cameras_are_those_that_are_not_disabled() -> None:
    assert ros1.cameras(ros1.Config(disabled_cameras=["cam_high"]), ROBOT) == (
        "cam_left_wrist",
        "cam_right_wrist",
    )


def test_a_robot_of_the_other_generation_needs_topics_of_the_deployments() -> None:
    with pytest.raises(
        ConfigurationError, match=r"no topic of camera \w+ .* is known; needed: transport\.topics"
    ):
        ros1.cameras(ros1.Config(), robots.load_robot("r1_lite"))
