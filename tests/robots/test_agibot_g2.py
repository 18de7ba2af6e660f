"""The G2's numbers against another program's, its mirror, its gripper and what stands on the floor."""

from __future__ import annotations

import numpy as np
import pytest

from robots import Body, load_robot
from robots.clearance import MARGIN, Clearance
from robots.rotations import matrix_of_quaternion, rotation_vector, transform_of
from tests.robots.standing import lowest

ROBOT = load_robot("agibot_g2")
MIRROR = np.array([-1, 1, -1, 1, -1, 1, -1])  # of the arm's joints
CHECKS = {  # arm, joints: position and wxyz in body_link5, then from the floor
    "left home": (
        ("left_arm", [0.739033, -0.717023, -1.524419, -1.537612, 0.27811, -0.925845, -0.839257]),
        ([0.511180351, 0.313090145, 0.348942526], [0.340763981, -0.090388764, 0.71603484, -0.60249804]),
        ([0.661329049, 0.313090145, 0.941720356], [0.159543241, -0.231920733, 0.776770196, -0.563370917]),
    ),
    "left": (
        ("left_arm", [1.9065, 0.0441, -0.7785, 0.9945, -0.9203, -0.6424, 1.1676]),
        ([0.00616172, 0.625650748, 0.728522297], [0.957290969, 0.190440481, 0.217544989, 0.000775421]),
        ([0.390498585, 0.625650748, 1.512487805], [0.877434353, 0.185094482, 0.440273526, -0.044813067]),
    ),
    "right home": (
        ("right_arm", [-0.739033, -0.717023, 1.524419, -1.537612, -0.27811, -0.925845, 0.839257]),
        ([0.511178421, -0.313090142, 0.348944266], [0.340762237, 0.090386725, 0.716034349, 0.602499916]),
        ([0.661328149, -0.313090142, 0.941722794], [0.159541665, 0.231919202, 0.776769302, 0.563373227]),
    ),
    "right": (
        ("right_arm", [0.3917, -1.2599, 0.1301, -0.6596, -2.0553, 0.9757, 0.2193]),
        ([0.543347937, -0.191873671, 0.777053616], [0.989905564, -0.127054735, 0.033669529, 0.053013513]),
        ([0.888728053, -0.191873671, 1.305868062], [0.953096802, -0.110679964, 0.269542479, 0.081873583]),
    ),
}


@pytest.mark.parametrize("check", CHECKS)
def test_forward_kinematics_agrees_with_another_implementation(check: str) -> None:
    (name, joints), (position, wxyz), (from_floor, wxyz_from_floor) = CHECKS[check]
    arm = ROBOT.group(name)
    q = ROBOT.poses["home"].copy()
    q[arm.joint_dims] = joints
    pose = arm.pose(q)
    np.testing.assert_allclose(pose[:3], position, rtol=0, atol=2e-9)
    np.testing.assert_allclose(pose[3:], wxyz, rtol=0, atol=2e-9)
    body = Body(ROBOT)
    seen = np.linalg.inv(transform_of(ROBOT.stand)) @ body.poses(q)[body.link_of(name, arm.eef_link)]
    np.testing.assert_allclose(seen[:3, 3], from_floor, rtol=0, atol=2e-9)
    np.testing.assert_allclose(seen[:3, :3], matrix_of_quaternion(np.array(wxyz_from_floor)), atol=5e-9)


@pytest.mark.parametrize("pose", ROBOT.poses)
def test_named_poses_are_mirror_images_about_the_robots_xz_plane(pose: str) -> None:
    q = ROBOT.poses[pose]
    left, right = ROBOT.arms
    np.testing.assert_array_equal(q[right.joint_dims], MIRROR * q[left.joint_dims])
    assert q[left.gripper_dim] == q[right.gripper_dim] == left.gripper.open
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    wanted, found = flip @ left.transform(q) @ flip, right.transform(q)
    assert np.linalg.norm(found[:3, 3] - wanted[:3, 3]) < 5e-6  # of 1 mm
    turned = np.degrees(np.linalg.norm(rotation_vector(found[:3, :3] @ wanted[:3, :3].T)))
    assert turned < 0.001  # of 0.1


def test_twenty_four_numbers_are_the_wires() -> None:
    arms = [
        [*(f"idx{first}{index}_arm_{side}_joint{index}" for index in range(1, 8)), gripper]
        for first, side, gripper in (
            (2, "l", "idx41_gripper_l_outer_joint1"),
            (6, "r", "idx81_gripper_r_outer_joint1"),
        )
    ]
    head = [f"idx1{index}_head_joint{index}" for index in range(1, 4)]
    body = [f"idx0{index}_body_joint{index}" for index in range(1, 6)]
    assert [list(group.joints) for group in ROBOT.groups] == [*arms, head, body]
    assert [(group.name, group.kind) for group in ROBOT.groups] == [
        ("left_arm", "arm"),
        ("right_arm", "arm"),
        ("head", "head"),
        ("body", "torso"),
    ]
    assert (ROBOT.dim, ROBOT.eef_dim, len(ROBOT.arms)) == (24, 16, 2)
    assert [camera.key for camera in ROBOT.cameras] == ["top_head", "hand_left", "hand_right"]


def test_head_and_body_move_what_hangs_on_them_and_no_pose_of_an_arm() -> None:
    body = Body(ROBOT)
    q = ROBOT.poses["home"]
    for group, moving, still in (("head", "head_link3", "body_link5"), ("body", "body_link5", "base_link")):
        moved = q.copy()
        moved[ROBOT.group(group).slice] += 0.05
        before, after = body.poses(q), body.poses(moved)
        for link, moves in ((moving, True), (still, False)):
            part = body.link_of(group, link)
            assert np.allclose(before[part], after[part]) != moves
        for arm in ROBOT.arms:
            np.testing.assert_array_equal(arm.pose(moved), arm.pose(q))
            hand = body.link_of(arm.name, arm.eef_link)
            assert np.allclose(before[hand], after[hand]) != (group == "body")


def fingertips(number: float) -> np.ndarray:
    """Where the ends of both pads of the left gripper are in its end effector, [2, 3], at its number."""
    body, arm = Body(ROBOT), ROBOT.arms[0]
    q = ROBOT.poses["home"].copy()
    q[arm.gripper_dim] = number
    poses = body.poses(q)
    hand = np.linalg.inv(poses[body.link_of("left_arm", arm.eef_link)])
    ends = (("inner", [0.0478, -0.0223, 0, 1]), ("outer", [0.0478, 0.0223, 0, 1]))
    return np.array(
        [(hand @ poses[body.link_of("left_arm", f"gripper_l_{side}_link4")] @ end)[:3] for side, end in ends]
    )


def test_the_fingertips_meet_at_zero_and_open_as_far_as_the_description_says() -> None:
    gripper = ROBOT.arms[0].gripper
    assert (gripper.close, gripper.open, gripper.threshold, gripper.binary) == (0.0, -0.785, -0.4, True)
    for number, apart in zip((gripper.close, gripper.open), gripper.apart, strict=True):
        first, second = fingertips(number)
        assert np.linalg.norm(first - second) == pytest.approx(apart, abs=0.001)
    halfway = fingertips((gripper.close + gripper.open) / 2)
    assert np.linalg.norm(halfway[0] - halfway[1]) == pytest.approx(gripper.apart[1] / 2, abs=0.004)


def test_the_tip_is_where_the_fingertips_meet_and_its_y_the_way_they_open() -> None:
    first, second = fingertips(0.0)
    tip = ROBOT.arms[0].tip
    np.testing.assert_allclose((first + second) / 2, tip[:3, 3], rtol=0, atol=0.001)
    opened = np.diff(fingertips(-0.785), axis=0)[0]
    assert abs(opened @ tip[:3, 1]) > 0.999 * np.linalg.norm(opened)
    np.testing.assert_allclose(tip[:3, 2], [0, 0, 1], atol=1e-12)


def test_it_stands_on_the_floor_with_its_arms_above_the_table() -> None:
    low = lowest(ROBOT)
    assert min(low.values()) == pytest.approx(ROBOT.stand[2] - 0.04, abs=0.001)  # the wheels
    above = [z for link, z in low.items() if link.startswith(("arm_", "gripper_"))]
    assert len(above) == 2 * (7 + 10)
    assert min(above) > 0.1


def test_nothing_touches_on_the_straight_way_from_home_to_ready() -> None:
    home, ready = (ROBOT.poses[name] for name in ("home", "ready"))
    way = home + np.linspace(0, 1, 21)[:, None] * (ready - home)
    clearance = Clearance(ROBOT)
    assert ("left_arm/arm_l_link7", "table") in clearance.pairs
    assert clearance.distances(way).min() > MARGIN


def test_ready_holds_the_fingers_down_and_open_beside_the_workspace() -> None:
    q = ROBOT.poses["ready"]
    body = Body(ROBOT)
    for arm, side in zip(ROBOT.arms, (-1, 1), strict=True):
        tip = body.poses(q)[body.link_of(arm.name, arm.eef_link)] @ arm.tip
        np.testing.assert_allclose(tip[:3, 2], [0, 0, -1], atol=0.002)
        np.testing.assert_allclose(tip[:3, 3], [side * 0.36, 0.22, 0.22], atol=0.002)
        own = arm.joint_dims
        assert np.minimum(q - ROBOT.lower, ROBOT.upper - q)[own].min() > 0.1
