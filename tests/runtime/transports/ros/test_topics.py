from __future__ import annotations

import dataclasses
from typing import Any

import pytest

import robots
from robots import Robot
from runtime.core.errors import ConfigurationError
from runtime.transports.ros.topics import CommandTopic, GroupTopics, TopicPlan, Topics

SPLIT = robots.load_robot("r1_lite")  # its grippers have topics of their own, and its stack is ROS 2
BARE = robots.load_robot("ur5e")  # no topics at all


def plan(robot: Robot = SPLIT, disabled: list[str] | None = None, **given: Any) -> TopicPlan:
    return TopicPlan(robot, 2, Topics(**given), disabled or [])


def group(**topics: Any) -> GroupTopics:
    return GroupTopics(**topics)


def test_the_robots_own_topics_are_listened_to() -> None:
    parts = {part.name: part for part in plan().streams(eef=True)}
    assert {name: (part.topic, part.message) for name, part in parts.items() if "left" in name} == {
        "cam_left_wrist": ("/hdas/camera_wrist_left/color/image_raw/compressed", "CompressedImage"),
        "left_arm joints": ("/hdas/feedback_arm_left", "JointState"),
        "left_arm gripper": ("/hdas/feedback_gripper_left", "JointState"),
        "left_arm eef": ("/relaxed_ik/motion_control/pose_ee_arm_left", "PoseStamped"),
    }
    assert parts["left_arm joints"].joints == SPLIT.group("left_arm").joints[:6]
    assert parts["left_arm gripper"].joints == ("left_gripper_joint",)
    assert len(parts) == 3 + 2 * 3
    assert not [part for part in plan().streams(eef=False) if part.kind == "eef"]


def test_commands_are_split_as_the_topics_are() -> None:
    outlets = {outlet.topic: outlet for outlet in plan().command_topics(["robot"], eef=False)}
    assert outlets["/motion_target/target_joint_state_arm_right"].dims == (7, 8, 9, 10, 11, 12)
    assert outlets["/motion_target/target_position_gripper_right"] == CommandTopic(
        "/motion_target/target_position_gripper_right", "JointState", (13,), ("right_gripper_joint",)
    )
    assert sorted(dim for outlet in outlets.values() for dim in outlet.dims) == list(range(14))


def test_a_deployment_overrides_topics_and_takes_some_away() -> None:
    made = plan(
        cameras={"head": "/other/image"},
        groups={
            "left_arm": group(gripper_state="", gripper_command="", state="/left", joints=list("abcdefg"))
        },
    )
    parts = {part.name: part for part in made.streams(eef=False)}
    assert (parts["cam_high"].topic, parts["cam_high"].message) == ("/other/image", "Image")
    assert parts["left_arm joints"].topic == "/left"
    assert parts["left_arm joints"].joints == tuple("abcdefg")
    assert "left_arm gripper" not in parts
    outlets = {outlet.topic: outlet for outlet in made.command_topics(["robot"], eef=False)}
    assert outlets["/motion_target/target_joint_state_arm_left"].joints == tuple("abcdefg")


def test_cameras_that_are_disabled_and_groups_that_are_left_out_have_no_topics() -> None:
    half = robots.load_robot("r1_lite", ["right_arm"])
    made = plan(half, ["cam_high", "cam_left_wrist"])
    assert {part.name for part in made.streams(eef=True)} == {
        "cam_right_wrist", "right_arm joints", "right_arm gripper", "right_arm eef"
    }  # fmt: skip
    assert {outlet.topic for outlet in made.command_topics(["robot"], eef=False)} == {
        "/motion_target/target_joint_state_arm_right", "/motion_target/target_position_gripper_right"
    }  # fmt: skip


def test_the_simulation_is_told_first_and_in_one_piece() -> None:
    simulation = {f"{side}_arm": group(simulation=f"/sim/{side}") for side in ("left", "right")}
    outlets = plan(groups=simulation).command_topics(["simulation", "robot"], eef=False)
    assert [outlet.topic for outlet in outlets[:2]] == ["/sim/left", "/sim/right"]
    assert outlets[0].dims == tuple(range(7))
    assert len(outlets) == 6


def test_poses_are_published_beside_grippers() -> None:
    posed = {f"{side}_arm": group(eef_command=f"/pose/{side}", command="") for side in ("left", "right")}
    outlets = plan(groups=posed).command_topics(["robot"], eef=True)
    assert [(outlet.topic, outlet.message, outlet.arm) for outlet in outlets if outlet.arm >= 0] == [
        ("/pose/left", "PoseStamped", 0), ("/pose/right", "PoseStamped", 1)
    ]  # fmt: skip
    assert {outlet.frame for outlet in outlets if outlet.arm >= 0} == {"base_link"}
    assert [outlet.dims for outlet in outlets if outlet.arm < 0] == [(6,), (13,)]


def test_groups_may_share_topics() -> None:
    shared = {f"{side}_arm": group(state="/joint_states", command="/command", gripper_state="", gripper_command="")
              for side in ("left", "right")}  # fmt: skip
    made = plan(groups=shared)
    assert [part.topic for part in made.streams(eef=False)].count("/joint_states") == 2
    (outlet,) = made.command_topics(["robot"], eef=False)
    assert outlet.dims == tuple(range(14))
    assert outlet.joints == SPLIT.groups[0].joints + SPLIT.groups[1].joints


def test_a_shared_topic_of_commands_needs_different_names() -> None:
    twins = robots.load_robot("agilex_piper")
    given = {"cameras": {camera.name: f"/{camera.name}" for camera in twins.cameras}}
    both = {one.name: group(state=f"/{one.name}", command="/command") for one in twins.groups}
    with pytest.raises(ConfigurationError, match="several commands go to /command; allowed: one per topic"):
        plan(twins, **given, groups=both).command_topics(["robot"], eef=False)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"cameras": {"nose": "/x"}}, r"topics\.cameras: nose not of r1_lite; allowed: head, left_wrist"),
        ({"groups": {"tail": GroupTopics()}}, r"topics\.groups: tail not of r1_lite; allowed: left_arm"),
        (
            {"groups": {"left_arm": group(joints=["a"] * 7)}},
            r"left_arm\.joints = .*allowed: 7 different names",
        ),
        ({"groups": {"left_arm": group(joints=["a"])}}, r"left_arm\.joints = \['a'\]"),
        ({"disabled": ["cam_tail"]}, "disabled_cameras: cam_tail not of r1_lite; allowed: cam_high"),
    ],
)
def test_what_is_not_the_robots_is_refused_by_name(given: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        plan(**given)


def test_missing_topics_are_refused_by_the_key_that_would_name_them() -> None:
    bare = plan(BARE)
    with pytest.raises(
        ConfigurationError, match=r"transport\.topics\.cameras\.wrist_image, or \"cam_wrist\" among"
    ):
        bare.streams(eef=False)
    with pytest.raises(ConfigurationError, match=r"transport\.topics\.groups\.arm\.state"):
        plan(BARE, ["cam_wrist", "cam_high"]).streams(eef=False)
    with pytest.raises(ConfigurationError, match=r"transport\.topics\.groups\.arm\.command"):
        bare.command_topics(["robot"], eef=False)
    with pytest.raises(ConfigurationError, match=r"groups\.left_arm\.simulation"):
        plan().command_topics(["simulation"], eef=False)
    with pytest.raises(ConfigurationError, match=r"groups\.left_arm\.eef_command"):
        plan().command_topics(["robot"], eef=True)
    silent = {"left_arm": group(command="")}
    with pytest.raises(ConfigurationError, match=r"groups\.left_arm\.command"):
        plan(groups=silent).command_topics(["robot"], eef=False)


def test_topics_of_the_other_ros_are_not_taken() -> None:
    assert SPLIT.ros is not None
    other = dataclasses.replace(SPLIT, ros=SPLIT.ros.model_copy(update={"version": 1}))
    with pytest.raises(ConfigurationError, match="no topic of camera head"):
        plan(other).streams(eef=False)
