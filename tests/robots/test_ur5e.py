"""The UR5e with an AG-95: posture, jaws and stand of its description, and what it looks like."""

from __future__ import annotations

import numpy as np
import pytest

from robots import load_robot
from robots.body import Body
from tests.robots.standing import extents, tip_in_scene

ROBOT = load_robot("ur5e")
JAWS = ("left_finger_pad", "right_finger_pad")


def test_it_has_one_arm_of_seven_numbers_with_a_binary_gripper() -> None:
    assert ROBOT.dim == 7
    (arm,) = ROBOT.arms
    assert arm.joints == (*arm.urdf_joints, "gripper_position")
    assert arm.gripper is not None
    assert arm.gripper.binary
    assert (arm.gripper.index, arm.gripper.open, arm.gripper.close, arm.gripper.threshold) == (
        6,
        1.0,
        0.0,
        0.5,
    )
    assert ROBOT.binary_dims == (6,)


def test_home_stands_in_front_of_the_table_fingers_down() -> None:
    tip = tip_in_scene(ROBOT, ROBOT.arms[0], ROBOT.poses["home"])
    np.testing.assert_allclose(tip[:3, 3], [-0.043, 0.2, 0.225], rtol=0, atol=1e-3)
    assert np.degrees(np.arccos(-tip[2, 2])) < 5


def test_pads_stay_parallel_and_come_ahead_as_they_close_and_never_beyond_the_tip() -> None:
    (arm,) = ROBOT.arms
    scene = Body(ROBOT)
    pads = [scene.link_of(arm.name, link) for link in JAWS]
    foremost = []
    for opening in (1.0, 0.5, 0.0):
        q = ROBOT.poses["ready"].copy()
        q[arm.gripper_dim] = opening
        inside = np.linalg.inv(tip_in_scene(ROBOT, arm, q))
        left, right = (inside @ scene.poses(q)[pad] for pad in pads)
        np.testing.assert_allclose(left[:3, 2], [0, 0, 1], atol=1e-6)
        np.testing.assert_allclose(right[:3, 2], [0, 0, 1], atol=1e-6)
        foremost.append(left[2, 3] + extents(ROBOT, JAWS[0])[1][2])
    assert foremost == sorted(foremost)
    assert -0.02 < foremost[0] < -0.01
    assert foremost[-1] == pytest.approx(0.0, abs=3e-4)
