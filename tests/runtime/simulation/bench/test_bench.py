from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from runtime.core.errors import SetupError
from runtime.simulation.bench import bench
from runtime.simulation.bench.arm_frames import ArmFrames
from runtime.simulation.bench.bench import Bench, BenchError

ROBOT = robots.load_robot("agilex_piper")
READY = ROBOT.poses["ready"]
LEFT, RIGHT = ROBOT.arms
X_FROM, X_TO, Y_FROM, Y_TO = Bench().area


@given(st.floats(0, 639), st.floats(0, 479), st.floats(0, 0.1))
def test_the_overhead_camera_projects_what_its_pixels_show(u: float, v: float, z: float) -> None:
    camera = bench.overhead_camera(640, 480)
    x, y = camera.pixel_to_table(u, v, z)
    np.testing.assert_allclose(camera.project(np.array([x, y, z])), (u, v), atol=1e-6)


def test_the_overhead_picture_shows_the_area_with_a_margin_and_far_is_up() -> None:
    camera = bench.overhead_camera(640, 480)
    corners = np.array([(x, y, 0.0) for x in (X_FROM, X_TO) for y in (Y_FROM, Y_TO)])
    pixels = camera.project(corners)
    assert (pixels > 60).all()
    assert (pixels < np.array([580, 420])).all()
    near_left, far_left, near_right, _ = pixels
    assert far_left[1] < near_left[1]
    assert near_left[0] < near_right[0]


def test_a_pixel_above_the_horizon_shows_no_place_and_what_is_behind_no_pixel() -> None:
    camera = bench.wrist_camera(bench.tip_in_world(ROBOT, LEFT, ROBOT.poses["home"]), 640, 480)
    with pytest.raises(BenchError, match="shows nothing"):
        camera.pixel_to_table(320, -4000)
    behind = camera.pose[:3, 3] - camera.pose[:3, 2]
    assert np.isnan(camera.project(behind)).all()


def test_cameras_are_where_their_names_say() -> None:
    found = {camera.name: bench.camera_arm(ROBOT, camera) for camera in ROBOT.cameras}
    assert found == {"front": None, "left_wrist": LEFT, "right_wrist": RIGHT}
    moved = READY.copy()
    moved[LEFT.joint_dims[0]] += 0.5
    before, after = (bench.cameras(ROBOT, q, 640, 480) for q in (READY, moved))
    changed = [key for key in before if not np.array_equal(before[key].pose, after[key].pose)]
    assert changed == ["cam_left_wrist"]


@pytest.mark.parametrize("arm", ROBOT.arms, ids=["left", "right"])
def test_a_wrist_camera_sees_its_own_fingertips_in_the_middle_with_the_arm_behind(arm: robots.Group) -> None:
    tip = bench.tip_in_world(ROBOT, arm, READY)
    camera = bench.wrist_camera(tip, 640, 480)
    u, v = camera.project(tip[:3, 3])
    assert u == pytest.approx(319.5, abs=1)
    assert 250 < v < 350
    rotation = camera.pose[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_in_pose_ready_fingers_point_down_open_and_leave_the_area_in_view() -> None:
    camera = bench.overhead_camera(640, 480)
    left_edge = camera.project(np.array([X_FROM, 0.3, 0.0]))[0]
    for arm in ROBOT.arms:
        tip = bench.tip_in_world(ROBOT, arm, READY)
        assert math.degrees(math.acos(-tip[2, 2])) < 16
        assert 0.1 < tip[2, 3] < 0.2
        assert READY[arm.gripper_dim] == arm.gripper.open
        room = np.minimum(READY - ROBOT.lower, ROBOT.upper - READY)[arm.joint_dims]
        assert room.min() > 0.1
        wide = [
            tip[:3, 3] + side * 0.09 * tip[:3, 1] - 0.1 * up * tip[:3, 2] for side in (-1, 1) for up in (0, 1)
        ]
        pixels = camera.project(np.array(wide))[:, 0]
        inwards = pixels if arm is LEFT else 639 - pixels
        assert inwards.max() < left_edge - 30


def test_poses_on_the_table_and_their_yaw_agree() -> None:
    for yaw in (-3.0, 0.0, 0.4, 1.6):
        pose = bench.block_pose((0.1, 0.2, yaw), Bench().block_edge)
        assert bench.yaw_of(pose) == pytest.approx(yaw)
        assert pose[2, 3] == Bench().block_edge / 2


def test_a_group_that_is_no_arm_has_no_tip() -> None:
    base = dataclasses.replace(LEFT, chain=None)
    with pytest.raises(SetupError, match="group left_arm has no end effector; allowed: an arm"):
        ArmFrames(ROBOT, base)


@pytest.mark.parametrize(
    ("names", "arms", "carried"),
    [
        (("front", "left_wrist", "right_wrist"), ("left_arm", "right_arm"), (None, "left_arm", "right_arm")),
        (("head", "right_hand"), ("left_arm", "right_arm"), (None, "right_arm")),
        (("wrist_image", "exterior_image"), ("left_arm",), ("left_arm", None)),
        (("wrist_image",), ("left_arm", "right_arm"), (None,)),
    ],
)
def test_cameras_of_any_name_are_on_the_arm_that_they_are_called_after_or_look_from_above(
    names: tuple[str, ...], arms: tuple[str, ...], carried: tuple[str | None, ...]
) -> None:
    groups = tuple(arm for arm in ROBOT.arms if arm.name in arms)
    robot = dataclasses.replace(
        ROBOT, groups=groups, cameras=tuple(robots.Camera(name, name) for name in names)
    )
    found = [bench.camera_arm(robot, camera) for camera in robot.cameras]
    assert tuple(None if arm is None else arm.name for arm in found) == carried
