from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from runtime.sim import bench
from runtime.sim.bench import APART_M, NOISE_M, NOISE_RAD, Bench, BenchError, layout_of

ROBOT = robots.load("agilex_piper")
READY = ROBOT.poses["ready"]
LEFT, RIGHT = ROBOT.arms
X_FROM, X_TO, Y_FROM, Y_TO = Bench().area
SEEDS = st.integers(0, 2**63 - 1)


@given(SEEDS, st.integers(1, 4))
def test_every_layout_lies_in_the_area_apart_and_on_one_side(seed: int, blocks: int) -> None:
    layout = layout_of(seed, None, blocks)
    assert len(layout.blocks) == blocks
    for x, y, _ in [*layout.blocks, (*layout.plate, 0.0)]:
        assert X_FROM <= x <= X_TO
        assert Y_FROM <= y <= Y_TO
    assert all(math.dist(block[:2], layout.plate) >= APART_M for block in layout.blocks)
    apart = [math.dist(a[:2], b[:2]) for a in layout.blocks for b in layout.blocks if a is not b]
    assert min(apart, default=1.0) > 0.08
    feet = [arm.mount[:2] for arm in ROBOT.arms]
    task = (layout.blocks[0][:2], layout.plate)
    assert any(all(math.dist(foot, place) <= 0.42 for place in task) for foot in feet)


@given(SEEDS)
def test_a_layout_is_always_the_same_for_a_seed_and_near_what_was_asked_for(seed: int) -> None:
    positions = {"block": [0.1, 0.2, 30.0], "plate": [0.15, 0.36]}
    layout = layout_of(seed, positions)
    assert layout == layout_of(seed, positions)
    x, y, yaw = layout.blocks[0]
    assert np.abs(np.subtract((x, y, *layout.plate), (0.1, 0.2, 0.15, 0.36))).max() <= NOISE_M
    assert abs(yaw - math.radians(30)) <= NOISE_RAD


def test_layouts_differ_by_seed_with_and_without_positions() -> None:
    for positions in (None, {"block": [0.1, 0.2, 0.0], "plate": [0.15, 0.36]}, {"plate": [0.1, 0.3]}):
        assert len({layout_of(seed, positions) for seed in range(20)}) == 20


@pytest.mark.parametrize(
    ("positions", "says"),
    [
        ({"bowl": [0.0, 0.3]}, "bowl; allowed: block, plate"),
        ({"block": [0.0, 0.3]}, "allowed: 3 finite numbers"),
        ({"block": "here"}, "allowed: 3 finite numbers"),
        ({"plate": [0.0, math.nan]}, "allowed: 2 finite numbers"),
        ({"plate": [0.0, True]}, "allowed: 2 finite numbers"),
        ({"plate": [0.5, 0.3]}, "x -0.22 to 0.22 m"),
        ({"block": [0.0, 0.3, 0.0], "plate": [0.1, 0.3]}, "0.100 m apart; allowed: 0.15 m or more"),
        ({"block": [0.0, 0.3, 0.0], 3: [0.1, 0.3]}, "name 3"),
    ],
)
def test_positions_that_cannot_be_are_refused_with_a_sentence(positions: dict, says: str) -> None:
    with pytest.raises(BenchError, match=says):
        layout_of(0, positions)


@pytest.mark.parametrize(("seed", "blocks"), [(0, 0), (-1, 1), (0, 60)])
def test_blocks_that_do_not_fit_are_refused(seed: int, blocks: int) -> None:
    with pytest.raises(BenchError, match="block"):
        layout_of(seed, None, blocks)


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
    camera = bench.wrist_camera(bench.tip_in_world(LEFT, ROBOT.poses["home"]), 640, 480)
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
    tip = bench.tip_in_world(arm, READY)
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
        tip = bench.tip_in_world(arm, READY)
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
        pose = bench.on_table((0.1, 0.2, yaw), Bench())
        assert bench.yaw_of(pose) == pytest.approx(yaw)
        assert pose[2, 3] == Bench().block_edge / 2


def test_a_group_that_is_no_arm_has_no_tip() -> None:
    base = dataclasses.replace(LEFT, chain=None)
    with pytest.raises(BenchError, match="allowed: an arm"):
        bench.tip_in_world(base, READY)
