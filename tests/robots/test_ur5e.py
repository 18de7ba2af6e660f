"""The UR5e with an AG-95: posture, jaws and stand of its description, and what it looks like."""

from __future__ import annotations

import numpy as np
import pytest

from robots import load
from robots.body import Body
from robots.clearance import MARGIN
from tests.robots.standing import at_ready, extents, from_home_to_ready, gap_as_said, tip_in_scene, unreached

ROBOT = load("ur5e")
EXTENTS = {  # of the meshes of the published description [m]
    "base_link_inertia": ([-0.0755, -0.0755, -0.0], [0.0755, 0.0755, 0.0991]),
    "shoulder_link": ([-0.0601, -0.0744, -0.0639], [0.0601, 0.0601, 0.0715]),
    "upper_arm_link": ([-0.4846, -0.0601, 0.0602], [0.0606, 0.0601, 0.2098]),
    "forearm_link": ([-0.4311, -0.058, -0.0495], [0.0584, 0.0578, 0.0604]),
    "wrist_1_link": ([-0.0393, -0.0536, -0.0736], [0.0394, 0.0563, 0.0386]),
    "wrist_2_link": ([-0.0393, -0.0567, -0.0461], [0.0393, 0.0531, 0.0391]),
    "wrist_3_link": ([-0.0376, -0.044, -0.0458], [0.0375, 0.0376, 0.0]),
    "ag95_base_link": ([-0.0465, -0.0335, -0.0035], [0.0465, 0.0335, 0.0147]),
    "ag95_body": ([-0.006, -0.0126, -0.0097], [0.087, 0.0397, 0.1198]),
    "left_outer_knuckle": ([-0.005, 0.0, -0.0063], [0.0605, 0.0175, 0.0063]),
    "left_inner_knuckle": ([-0.006, 0.0, -0.006], [0.006, 0.0508, 0.0605]),
    "left_finger": ([-0.0262, 0.0, -0.0055], [0.0055, 0.0175, 0.0225]),
    "left_finger_pad": ([-0.007, -0.0105, -0.0088], [0.005, 0.0105, 0.0252]),
    "right_outer_knuckle": ([-0.005, 0.0, -0.0063], [0.0605, 0.0175, 0.0063]),
    "right_inner_knuckle": ([-0.006, 0.0, -0.006], [0.006, 0.0508, 0.0605]),
    "right_finger": ([-0.0262, 0.0, -0.0055], [0.0055, 0.0175, 0.0225]),
    "right_finger_pad": ([-0.007, -0.0105, -0.0088], [0.005, 0.0105, 0.0252]),
}
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


def test_limits_are_those_of_the_urdf() -> None:
    assert ROBOT.overrides == ()
    assert "URDF" in ROBOT.limits_source


def test_home_stands_in_front_of_the_table_fingers_down() -> None:
    tip = tip_in_scene(ROBOT, ROBOT.arms[0], ROBOT.poses["home"])
    np.testing.assert_allclose(tip[:3, 3], [-0.043, 0.2, 0.225], rtol=0, atol=1e-3)
    assert np.degrees(np.arccos(-tip[2, 2])) < 5


@pytest.mark.parametrize("opening", [0.0, 1.0])
def test_jaws_are_as_far_apart_as_the_gripper_says(opening: float) -> None:
    ((apart, said),) = gap_as_said(ROBOT, JAWS, opening)
    assert apart == pytest.approx(said, abs=2e-4)


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
        foremost.append(left[2, 3] + EXTENTS[JAWS[0]][1][2])
    assert foremost == sorted(foremost)
    assert -0.02 < foremost[0] < -0.01
    assert foremost[-1] == pytest.approx(0.0, abs=3e-4)


def test_from_home_to_ready_nothing_touches_and_the_fingertips_stay_up() -> None:
    clearance, height = from_home_to_ready(ROBOT)
    assert clearance > MARGIN
    assert height > 0.19


def test_ready_is_outside_of_the_workspace_fingers_down_and_away_from_limits() -> None:
    for ready in at_ready(ROBOT):
        assert ready.beside > 0.1
        assert ready.off_vertical < 1
        assert ready.to_limit > 1.0
        assert ready.opened


def test_every_place_on_the_table_is_reached_from_above() -> None:
    assert unreached(ROBOT, (0.02, 0.15), tilt=0.0) == []


@pytest.mark.parametrize("link", EXTENTS)
def test_the_drawn_shapes_of_a_link_fill_the_extents_of_the_real_one_to_1_mm(link: str) -> None:
    np.testing.assert_allclose(extents(ROBOT, link), EXTENTS[link], rtol=0, atol=0.001)
