"""A script in poses says the same as it does in joints."""

from __future__ import annotations

import numpy as np
import pytest

import robots
from runtime.core.errors import SetupError
from runtime.core.pose_format import PoseFormat
from runtime.simulation.scripts.pose_script import PoseScript, pose_format
from runtime.simulation.scripts.script import WavingScript
from runtime.spaces.pose_rows import PoseRows

FORMATS = [
    PoseFormat(),
    PoseFormat(orientation="6d", sixd="rows"),
    PoseFormat(orientation="euler", euler_order="ZYX", degrees=True, gripper=False),
]


@pytest.mark.parametrize("name", robots.robot_names())
@pytest.mark.parametrize("pose", FORMATS, ids=str)
def test_its_rows_are_the_poses_of_the_joint_rows(name, pose):
    robot = robots.load_robot(name)
    waving, q = WavingScript(robot, 12, 30.0), robot.poses["ready"]
    rows = PoseScript(waving, robot, 30.0, pose).begin()(q, {}, "")
    vectors, appended = PoseRows(pose, robot).decode(rows.astype(np.float64))
    joints = waving.begin()(q, {}, "").astype(np.float64)
    assert rows.shape == (12, PoseRows(pose, robot).width)
    assert appended.shape == (12, 0)
    for index, arm in enumerate(robot.arms):
        poses = arm.pose(joints)
        np.testing.assert_allclose(vectors[:, index, :3], poses[:, :3], atol=1e-6)
        same = np.abs(np.sum(vectors[:, index, 3:7] * poses[:, 3:], axis=1))
        np.testing.assert_allclose(same, 1.0, atol=1e-6)
        gripper = joints[:, arm.gripper_dim] if pose.gripper else 0.0
        np.testing.assert_allclose(vectors[:, index, 7], gripper, atol=1e-5)


def test_groups_that_follow_the_poses_come_as_joints():
    robot = robots.load_robot("agibot_g2")
    q = robot.poses["ready"]
    rows = PoseScript(WavingScript(robot, 5, 30.0), robot, 30.0, PoseFormat(groups=["body", "head"])).begin()(
        q, {}, ""
    )
    expected = np.concatenate([q[robot.group("body").slice], q[robot.group("head").slice]])
    np.testing.assert_allclose(rows[:, -len(expected) :], np.tile(expected, (5, 1)), atol=1e-6)


def test_it_says_how_its_rows_are_written():
    robot = robots.load_robot("ur5e")
    metadata = PoseScript(WavingScript(robot, 5, 25.0), robot, 25.0, PoseFormat(orientation="xyzw")).metadata
    assert (metadata["action_space"], metadata["action_dim"], metadata["action_rate"]) == ("eef", 8, 25.0)
    assert metadata["action_pose"]["orientation"] == "xyzw"
    assert metadata["action_horizon"] == 5


def test_a_format_is_read_as_a_deployment_has_it():
    assert pose_format([]) == PoseFormat()
    given = ["orientation=euler", 'euler_order="XYZ"', "degrees=true", 'groups=["head"]']
    assert pose_format(given) == PoseFormat(
        orientation="euler", euler_order="XYZ", degrees=True, groups=["head"]
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["orientation"], "--pose orientation; allowed: KEY=VALUE with orientation, euler_order"),
        (["orientation=quat"], "orientation"),
        (["degrees=true"], "allowed: with orientation"),
    ],
)
def test_a_format_that_is_none_is_refused(given, said):
    with pytest.raises(SetupError, match=said):
        pose_format(given)


def test_a_frame_that_the_robot_has_not_is_refused():
    robot = robots.load_robot("ur5e")
    with pytest.raises(SetupError, match="nowhere"):
        PoseScript(WavingScript(robot, 5, 25.0), robot, 25.0, PoseFormat(frame="nowhere"))
