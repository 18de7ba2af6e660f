"""The ARX R5: limits, postures and jaws of its description, and what they look like."""

from __future__ import annotations

import numpy as np

from robots import load_robot

ROBOT = load_robot("arx_r5")


def test_it_has_two_arms_of_seven_numbers() -> None:
    assert ROBOT.dim == 14
    assert [arm.name for arm in ROBOT.arms] == ["left_arm", "right_arm"]
    for arm in ROBOT.arms:
        assert arm.joints == ("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "gripper")
        assert arm.gripper is not None
        assert not arm.gripper.binary
        assert (arm.gripper.index, arm.gripper.open, arm.gripper.close) == (6, 1.0, 0.0)
    np.testing.assert_array_equal(ROBOT.poses["home"][[6, 13]], 1.0)


def test_no_limit_is_the_placeholder_of_the_urdf_and_each_says_why() -> None:
    joints = np.delete(np.arange(ROBOT.dim), ROBOT.gripper_dims)
    assert (np.abs(ROBOT.lower[joints]) < 4).all()
    assert (np.abs(ROBOT.upper[joints]) < 4).all()
    np.testing.assert_array_equal(ROBOT.velocity[joints], 5.0)
    assert len(ROBOT.overrides) == len(joints) * 3
    assert all("placeholder: " in sentence for sentence in ROBOT.overrides)
    assert "placeholders" in ROBOT.limits_source


def test_both_arms_have_the_same_limits() -> None:
    for side in (ROBOT.lower, ROBOT.upper, ROBOT.velocity):
        np.testing.assert_array_equal(side[:7], side[7:])
