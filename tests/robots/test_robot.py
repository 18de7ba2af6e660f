from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from robots import Camera, RobotError, load_robot

Edit = Callable[..., Path]


def test_names_are_in_the_order_of_the_vector() -> None:
    robot = load_robot("agilex_piper")
    joints = [f"joint{index}" for index in range(7)]
    expected = [f"left_arm.{joint}" for joint in joints] + [f"right_arm.{joint}" for joint in joints]
    assert list(robot.joint_names) == expected
    assert robot.eef_dim == 16
    fields = ["x", "y", "z", "qw", "qx", "qy", "qz", "gripper"]
    assert robot.eef_names[:8] == tuple(f"left_arm.{field}" for field in fields)
    assert robot.eef_names[15] == "right_arm.gripper"


def test_the_piper_is_what_the_wire_expects() -> None:
    robot = load_robot("agilex_piper")
    assert robot.cameras == (
        Camera("front", "cam_high"),
        Camera("left_wrist", "cam_left_wrist"),
        Camera("right_wrist", "cam_right_wrist"),
    )
    assert robot.gripper_dims == (6, 13)
    assert robot.binary_dims == ()
    left, right = robot.arms
    assert (left.slice, right.slice) == (slice(0, 7), slice(7, 14))
    assert left.urdf_joints == right.urdf_joints == tuple(f"joint{index}" for index in range(1, 7))
    assert right.joint_dims.tolist() == [7, 8, 9, 10, 11, 12]
    assert (left.frame, left.eef_link) == ("base_link", "gripper_base")
    assert left.gripper is not None
    assert (left.gripper.open, left.gripper.close, left.gripper.unit) == (0.1, 0.0, "m")
    np.testing.assert_array_equal(robot.poses["home"], np.zeros(14))
    np.testing.assert_array_equal(left.mount[:3], [-0.25, 0, 0])


def test_a_binary_gripper_is_listed(edited: Edit) -> None:
    robot = load_robot(edited(("binary = false", "binary = true\nthreshold = 0.05")))
    assert robot.binary_dims == (6,)
    assert robot.gripper_dims == (6, 13)


def test_join_undoes_split_for_single_vectors_and_for_rows() -> None:
    robot = load_robot("agilex_piper")
    rows = np.arange(28, dtype=np.float32).reshape(2, 14)
    for vector in (rows[0], rows):
        parts = robot.split(vector)
        assert list(parts) == ["left_arm", "right_arm"]
        joined = robot.join(parts)
        assert joined.dtype == np.float32
        np.testing.assert_array_equal(joined, vector)


def test_a_vector_or_a_part_of_another_length_is_refused() -> None:
    robot = load_robot("agilex_piper")
    with pytest.raises(RobotError, match=r"shape \(16,\) was given; allowed: \[..., 14\]"):
        robot.split(np.zeros(16))
    with pytest.raises(RobotError, match=r"right_arm was given \(6,\); allowed: \[..., 7\]"):
        robot.join({"left_arm": np.zeros(7), "right_arm": np.zeros(6)})
    with pytest.raises(RobotError, match="groups left_arm were given; needed: left_arm, right_arm"):
        robot.join({"left_arm": np.zeros(7)})
    with pytest.raises(RobotError, match="needed: left_arm, right_arm"):
        robot.join({"left_arm": np.zeros(7), "right_arm": np.zeros(7), "head": np.zeros(2)})


def test_an_unknown_group_is_answered_with_the_known_ones() -> None:
    with pytest.raises(RobotError, match="no group 'head'; it has left_arm, right_arm"):
        load_robot("agilex_piper").group("head")


def test_a_group_without_an_end_effector_is_no_arm(edited: Edit) -> None:
    folder = edited(('frame = "base_link"\neef_link = "gripper_base"\n', ""))
    robot = load_robot(folder)
    assert [arm.name for arm in robot.arms] == ["right_arm"]
    assert robot.eef_dim == 8
    assert robot.gripper_dims == (6, 13)
