from __future__ import annotations

import numpy as np
import pytest

from runtime.core.pose_format import PoseFormat
from runtime.policies.gripper_convention import GripperConvention
from runtime.spaces.pose_rows import PoseRows
from tests.runtime.policies.peers import FRANKA, PIPER, seen


def test_the_robots_own_numbers_pass_as_they_are() -> None:
    grip, shown = GripperConvention("robot", PIPER), seen(PIPER)
    assert grip.convert_observation(shown) is shown
    rows = np.ones((2, 14), np.float32)
    assert grip.to_robot(rows) is rows


@pytest.mark.parametrize("robot", [FRANKA, PIPER], ids=["franka", "piper"])
def test_open_is_zero_and_closed_is_one_both_ways(robot) -> None:
    grip = GripperConvention("droid", robot)
    ends = [(group.gripper.open, group.gripper.close) for group in robot.groups if group.gripper is not None]
    opened, closed = (np.array(values) for values in zip(*ends, strict=True))
    np.testing.assert_allclose(grip.to_policy(opened), 0.0)
    np.testing.assert_allclose(grip.to_policy(closed), 1.0)
    np.testing.assert_allclose(grip.to_policy(opened + 2 * (opened - closed)), 0.0)
    rows = np.zeros((3, robot.dim), np.float32)
    rows[1, list(robot.gripper_dims)] = 1.0
    rows[2, list(robot.gripper_dims)] = 7.0
    meant = grip.to_robot(rows)
    for row, expected in zip(meant, (opened, closed, closed), strict=True):
        np.testing.assert_allclose(row[list(robot.gripper_dims)], expected, atol=1e-7)
    assert not rows[0].any()  # what was given is left as it was


def test_joints_and_poses_of_an_observation_say_the_same() -> None:
    shown = seen(PIPER, 0.02)
    turned = GripperConvention("droid", PIPER).convert_observation(shown)
    share = 1 - 0.02 / 0.1
    assert turned.eef is not None
    assert turned.qpos[[6, 13]] == pytest.approx([share, share])
    assert turned.eef[[7, 15]] == pytest.approx([share, share])
    assert shown.qpos[6] == np.float32(0.02)
    np.testing.assert_array_equal(turned.qpos[:6], shown.qpos[:6])


def test_the_grippers_of_rows_of_poses_are_their_last_numbers() -> None:
    poses = PoseRows(PoseFormat(orientation="euler"), PIPER)
    rows = np.full((1, poses.width), 1.0, np.float32)
    meant = GripperConvention("droid", PIPER, poses).to_robot(rows)
    np.testing.assert_array_equal(meant, [[*[1] * 6, 0, *[1] * 6, 0]])
    bare = PoseRows(PoseFormat(orientation="euler", gripper=False), PIPER)
    rows = np.full((1, bare.width), 0.5, np.float32)
    np.testing.assert_array_equal(GripperConvention("droid", PIPER, bare).to_robot(rows), rows)
