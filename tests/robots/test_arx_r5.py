"""The ARX R5: limits, postures and jaws of its description, and what they look like."""

from __future__ import annotations

import numpy as np
import pytest

from robots import load
from robots.clearance import MARGIN
from tests.robots.standing import at_ready, extents, from_home_to_ready, gap_as_said, off_mirror, unreached

ROBOT = load("arx_r5")
EXTENTS = {  # of the meshes of the published description [m]
    "base_link": ([-0.0305, -0.0305, -0.0], [0.0305, 0.0305, 0.0625]),
    "link1": ([-0.019, -0.0382, -0.0], [0.0375, 0.0418, 0.0645]),
    "link2": ([-0.294, -0.0293, -0.03], [0.03, 0.0387, 0.03]),
    "link3": ([-0.028, -0.0432, -0.09], [0.275, 0.0413, 0.028]),
    "link4": ([-0.0175, -0.0375, -0.0865], [0.1013, 0.0371, 0.0175]),
    "link5": ([-0.0346, -0.0309, -0.0011], [0.0283, 0.031, 0.1177]),
    "link6": ([-0.0, -0.087, -0.03], [0.084, 0.087, 0.0303]),
    "link7": ([-0.0186, -0.0764, -0.0303], [0.071, 0.0125, 0.0307]),
    "link8": ([-0.0186, -0.0125, -0.0303], [0.071, 0.0764, 0.0307]),
}


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


@pytest.mark.parametrize("pose", ["home", "ready"])
def test_the_postures_of_the_arms_are_mirror_images(pose: str) -> None:
    place, turn = off_mirror(ROBOT, pose)
    assert place < 1e-5
    assert turn < 3e-5


@pytest.mark.parametrize("opening", [0.0, 0.5, 1.0])
def test_jaws_are_as_far_apart_as_the_gripper_says(opening: float) -> None:
    for apart, said in gap_as_said(ROBOT, ("link7", "link8"), opening):
        assert apart == pytest.approx(said, abs=1e-4)


def test_from_home_to_ready_nothing_touches_and_the_fingertips_stay_up() -> None:
    clearance, height = from_home_to_ready(ROBOT)
    assert clearance > MARGIN
    assert height > 0.14


def test_ready_is_outside_of_the_workspace_fingers_down_and_away_from_limits() -> None:
    for ready in at_ready(ROBOT):
        assert ready.beside > 0.1
        assert ready.off_vertical < 12
        assert ready.to_limit > 0.25
        assert ready.opened


def test_every_place_on_the_table_is_reached_from_above() -> None:
    assert unreached(ROBOT, (0.02, 0.15), tilt=0.26) == []


@pytest.mark.parametrize("link", EXTENTS)
def test_the_drawn_shapes_of_a_link_fill_the_extents_of_the_real_one_to_1_mm(link: str) -> None:
    np.testing.assert_allclose(extents(ROBOT, link), EXTENTS[link], rtol=0, atol=0.001)
