"""Two Frankas: mirrored postures, jaws and mounts of their description, and what they look like."""

from __future__ import annotations

import numpy as np

from robots import load_robot
from tests.robots.standing import (
    tip_in_scene,
)

ROBOT = load_robot("dual_franka")
SHIPPED = (-1.88733017, -0.98627802, 1.34066187, -1.77472402, 0.08241637, 1.8024626, 0.79725709)


def test_it_has_two_arms_of_eight_numbers() -> None:
    assert ROBOT.dim == 16
    assert [arm.name for arm in ROBOT.arms] == ["left_arm", "right_arm"]
    for arm in ROBOT.arms:
        assert arm.joints[-1] == "panda_finger_joint1"
        assert arm.joints[:-1] == arm.urdf_joints == tuple(f"panda_joint{number}" for number in range(1, 8))
        assert arm.gripper is not None
        assert not arm.gripper.binary
        assert (arm.gripper.index, arm.gripper.open, arm.gripper.close) == (7, 1.0, 0.0)
    assert ROBOT.mount_frame == "workcell"


def test_the_mounts_are_mirror_images_of_each_other() -> None:
    left, right = (arm.mount for arm in ROBOT.arms)
    np.testing.assert_allclose(left, right * [1, -1, 1, 1, -1, 1, -1], rtol=0, atol=1e-15)


def test_the_right_home_is_the_shipped_one_and_points_down_in_the_workcell() -> None:
    right = ROBOT.group("right_arm")
    np.testing.assert_array_equal(ROBOT.poses["home"][right.joint_dims], SHIPPED)
    np.testing.assert_allclose(tip_in_scene(ROBOT, right, ROBOT.poses["home"])[:3, 2], [0, 0, -1], atol=0.031)
