"""Two Frankas: mirrored postures, jaws and mounts of their description, and what they look like."""

from __future__ import annotations

import numpy as np
import pytest

from robots import load
from robots.clearance import MARGIN
from tests.robots.standing import (
    at_ready,
    extents,
    from_home_to_ready,
    gap_as_said,
    off_mirror,
    tip_in_scene,
    unreached,
)

ROBOT = load("dual_franka")
EXTENTS = {  # of the meshes of the published description [m]
    "panda_link0": ([-0.1541, -0.0946, 0.0], [0.0715, 0.0946, 0.14]),
    "panda_link1": ([-0.055, -0.1294, -0.192], [0.055, 0.055, 0.055]),
    "panda_link2": ([-0.055, -0.194, -0.055], [0.055, 0.055, 0.1294]),
    "panda_link3": ([-0.055, -0.055, -0.121], [0.1375, 0.1111, 0.055]),
    "panda_link4": ([-0.1375, -0.055, -0.055], [0.055, 0.124, 0.1111]),
    "panda_link5": ([-0.055, -0.055, -0.259], [0.055, 0.1299, 0.0522]),
    "panda_link6": ([-0.0479, -0.0512, -0.044], [0.132, 0.0817, 0.0563]),
    "panda_link7": ([-0.044, -0.044, 0.052], [0.0813, 0.0813, 0.1068]),
    "panda_hand": ([-0.0315, -0.1039, -0.0259], [0.0315, 0.1006, 0.066]),
    "panda_leftfinger": ([-0.0105, -0.0001, 0.0001], [0.0105, 0.0263, 0.0539]),
    "panda_rightfinger": ([-0.0105, -0.0263, 0.0001], [0.0105, 0.0001, 0.0539]),
}
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


def test_limits_are_those_of_the_urdf() -> None:
    assert ROBOT.overrides == ()
    assert "URDF" in ROBOT.limits_source


def test_the_mounts_are_mirror_images_of_each_other() -> None:
    left, right = (arm.mount for arm in ROBOT.arms)
    np.testing.assert_allclose(left, right * [1, -1, 1, 1, -1, 1, -1], rtol=0, atol=1e-15)


def test_the_right_home_is_the_shipped_one_and_points_down_in_the_workcell() -> None:
    right = ROBOT.group("right_arm")
    np.testing.assert_array_equal(ROBOT.poses["home"][right.joint_dims], SHIPPED)
    np.testing.assert_allclose(tip_in_scene(ROBOT, right, ROBOT.poses["home"])[:3, 2], [0, 0, -1], atol=0.031)


@pytest.mark.parametrize("pose", ["home", "ready"])
def test_the_postures_of_the_arms_are_mirror_images(pose: str) -> None:
    place, turn = off_mirror(ROBOT, pose)
    assert place < 1e-8
    assert turn < 1e-8


@pytest.mark.parametrize("opening", [0.0, 0.5, 1.0])
def test_jaws_are_as_far_apart_as_the_gripper_says(opening: float) -> None:
    for apart, said in gap_as_said(ROBOT, ("panda_leftfinger", "panda_rightfinger"), opening):
        assert apart == pytest.approx(said, abs=1e-4)


def test_from_home_to_ready_nothing_touches_and_the_fingertips_stay_up() -> None:
    clearance, height = from_home_to_ready(ROBOT)
    assert clearance > MARGIN
    assert height > 0.19


def test_ready_is_outside_of_the_workspace_fingers_down_and_away_from_limits() -> None:
    for ready in at_ready(ROBOT):
        assert ready.beside > 0.1
        assert ready.off_vertical < 1
        assert ready.to_limit > 0.5
        assert ready.opened


def test_every_place_on_the_table_is_reached_from_above() -> None:
    assert unreached(ROBOT, (0.02, 0.15), tilt=0.26) == []


@pytest.mark.parametrize("link", EXTENTS)
def test_the_drawn_shapes_of_a_link_fill_the_extents_of_the_real_one_to_1_mm(link: str) -> None:
    np.testing.assert_allclose(extents(ROBOT, link), EXTENTS[link], rtol=0, atol=0.001)
