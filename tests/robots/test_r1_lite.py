"""The R1 Lite's numbers against another program's, its mirror, its torso and what stands on the floor."""

from __future__ import annotations

import numpy as np
import pytest

from robots import Body, load_robot, shapes
from robots.clearance import MARGIN, Clearance
from robots.rotations import matrix_of_quaternion, rotation_vector, transform_of
from tests.robots.standing import lowest

ROBOT = load_robot("r1_lite")
WHOLE = load_robot("r1_lite", groups=["left_arm", "right_arm", "torso", "base"])
MIRROR = np.array([-1, 1, 1, 1, -1, -1])  # of the arm's joints
CHECKS = {  # arm, joints: position and wxyz in base_link, then in torso_link3
    "left home": (
        ("left_arm", [0.0] * 6),
        ([0.206670903, 0.33350976, 0.987323364], [0.9999755, 0.0, 0.006999943, 0.0]),
        ([0.058853, 0.33499943, 0.333845], [1.0, 0.0, 0.0, 0.0]),
    ),
    "right home": (
        ("right_arm", [0.0] * 6),
        ([0.206670903, -0.33649024, 0.987323364], [0.9999755, 0.0, 0.006999943, 0.0]),
        ([0.058853, -0.33500057, 0.333845], [1.0, 0.0, 0.0, 0.0]),
    ),
    "left": (
        ("left_arm", [1.2898, 1.2819, -0.1772, -1.3632, 1.0723, -2.1665]),
        (
            [0.113230177, 0.537543606, 1.111764718],
            [0.194955932, -0.324106508, -0.869091666, 0.318789637],
        ),
        (
            [-0.036320691, 0.539033276, 0.456966031],
            [0.188867564, -0.326330076, -0.870435053, 0.3165131],
        ),
    ),
    "right": (
        ("right_arm", [1.5486, 1.4012, -1.7789, -0.2736, 0.9994, 0.6325]),
        (
            [0.070638827, -0.142259178, 1.426716726],
            [0.236436514, 0.175318566, -0.009236081, 0.955654681],
        ),
        (
            [-0.083317051, -0.140769508, 0.771290915],
            [0.23636607, 0.168624742, -0.010890897, 0.956858488],
        ),
    ),
}


def vector(robot, arm, joints):
    q = robot.poses["home"].copy()
    q[robot.group(arm).joint_dims] = joints
    return q


@pytest.mark.parametrize("robot", [ROBOT, WHOLE], ids=["torso pinned", "torso on"])
@pytest.mark.parametrize("check", CHECKS)
def test_forward_kinematics_agrees_with_another_implementation(robot, check) -> None:
    (arm, joints), (position, wxyz), (from_torso, wxyz_from_torso) = CHECKS[check]
    q = vector(robot, arm, joints)
    pose = robot.group(arm).pose(q)
    np.testing.assert_allclose(pose[:3], position, rtol=0, atol=2e-9)
    np.testing.assert_allclose(pose[3:], wxyz, rtol=0, atol=2e-9)
    body = Body(robot)
    poses = body.poses(q)
    torso = poses[body.link_of(arm, "torso_link3")]
    seen = np.linalg.inv(torso) @ poses[body.link_of(arm, robot.group(arm).eef_link)]
    np.testing.assert_allclose(seen[:3, 3], from_torso, rtol=0, atol=2e-9)
    np.testing.assert_allclose(seen[:3, :3], matrix_of_quaternion(np.array(wxyz_from_torso)), atol=5e-9)


def mirrored(transform, y):
    """The transform as a mirror in the plane at y shows it, with its own y axis turned round."""
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    seen = flip @ transform @ flip
    seen[1, 3] += 2 * y
    return seen


@pytest.mark.parametrize("pose", ROBOT.poses)
def test_named_poses_are_mirror_images_about_the_torsos_plane(pose: str) -> None:
    q = ROBOT.poses[pose]
    left, right = ROBOT.arms
    np.testing.assert_array_equal(q[right.joint_dims], MIRROR * q[left.joint_dims])
    assert q[left.gripper_dim] == q[right.gripper_dim]
    wanted = mirrored(left.transform(q), 0.00036033 - 0.00185)
    found = right.transform(q)
    assert np.linalg.norm(found[:3, 3] - wanted[:3, 3]) < 2e-6
    assert np.linalg.norm(rotation_vector(found[:3, :3] @ wanted[:3, :3].T)) < 1e-6


def test_fourteen_numbers_are_the_wires_and_torso_and_base_come_when_asked() -> None:
    arms = [f"{side}_arm" for side in ("left", "right")]
    wire = [
        name
        for side in ("left", "right")
        for name in [*(f"{side}_arm_joint{index}" for index in range(1, 7)), f"{side}_gripper_joint"]
    ]
    assert [name for group in ROBOT.groups for name in group.joints] == wire
    assert [group.name for group in ROBOT.groups] == arms
    assert [(group.name, group.kind) for group in WHOLE.groups[2:]] == [("torso", "torso"), ("base", "base")]
    assert (ROBOT.dim, WHOLE.dim, WHOLE.eef_dim) == (14, 20, 16)
    assert {camera.name: camera.key for camera in ROBOT.cameras} == {
        "head": "cam_high",
        "left_wrist": "cam_left_wrist",
        "right_wrist": "cam_right_wrist",
    }


def test_a_torso_that_moves_carries_both_arms() -> None:
    q = vector(WHOLE, "left_arm", [0.2, 1.0, -0.9, 0.1, -0.3, 0.4])
    torso = WHOLE.group("torso")
    moved = q.copy()
    moved[torso.joint_dims] += [0.1, -0.2, 0.05]
    for arm in WHOLE.arms:
        before, after = arm.transform(q), arm.transform(moved)
        assert np.linalg.norm(after[:3, 3] - before[:3, 3]) > 0.01
        np.testing.assert_allclose(
            np.linalg.inv(arm.carried(moved)) @ after, np.linalg.inv(arm.carried(q)) @ before, atol=1e-12
        )


@pytest.mark.parametrize(("percent", "apart"), [(0.0, 0.0), (50.0, 0.05), (100.0, 0.1)])
def test_the_jaws_are_as_far_apart_as_the_gripper_says(percent: float, apart: float) -> None:
    body = Body(ROBOT)
    q = ROBOT.poses["home"].copy()
    closed = q.copy()
    for arm in ROBOT.arms:
        q[arm.gripper_dim], closed[arm.gripper_dim] = percent, 0.0
        jaws = list(body.jaws[arm.name])
        way = body.poses(q)[jaws, :3, 3] - body.poses(closed)[jaws, :3, 3]
        assert np.linalg.norm(way[0] - way[1]) == pytest.approx(apart, abs=1e-9)
        assert arm.gripper.apart == (0.0, 0.1)


def test_fingertips_are_where_the_fingers_end_and_point_the_way_the_hand_does() -> None:
    for arm in ROBOT.arms:
        ends = [
            shape.origin[0, 3] + shape.bounds()[1][0] + 0.03689
            for shape in shapes.read_shapes(ROBOT.urdf)
            if shape.link.startswith(arm.name.removesuffix("_arm") + "_gripper_finger")
        ]
        assert arm.tip[0, 3] == pytest.approx(max(ends), abs=1e-3)
        np.testing.assert_allclose(arm.tip[:3, 1:3], [[0, 1], [1, 0], [0, 0]], atol=1e-12)


def test_it_stands_on_the_floor_with_its_arms_above_the_table() -> None:
    low = lowest(ROBOT)
    assert min(low.values()) == pytest.approx(ROBOT.stand[2], abs=1e-3)
    above = [z for link, z in low.items() if "arm_link" in link or "gripper" in link or "D405" in link]
    assert len(above) == 2 * 10
    assert min(above) > 0.15


def test_nothing_touches_on_the_straight_way_from_home_to_ready() -> None:
    home, ready = (WHOLE.poses[name] for name in ("home", "ready"))
    way = home + np.linspace(0, 1, 21)[:, None] * (ready - home)
    clearance = Clearance(WHOLE)
    assert ("left_arm/left_gripper_link", "table") in clearance.pairs
    assert clearance.distances(way).min() > MARGIN


def test_ready_holds_the_fingers_down_and_open_beside_the_workspace() -> None:
    q = ROBOT.poses["ready"]
    scene = transform_of(ROBOT.stand)
    for arm, side in zip(ROBOT.arms, (-1, 1), strict=True):
        tip = scene @ arm.transform(q) @ arm.tip
        np.testing.assert_allclose(tip[:3, 2], [0, 0, -1], atol=0.02)
        np.testing.assert_allclose(tip[:3, 3], [side * 0.42, 0.25, 0.18], atol=0.005)
        assert q[arm.gripper_dim] == arm.gripper.open
        own = arm.joint_dims
        assert np.minimum(q - ROBOT.lower, ROBOT.upper - q)[own].min() > 0.1
