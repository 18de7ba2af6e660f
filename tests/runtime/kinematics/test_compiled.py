from __future__ import annotations

import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robots import Robot, load
from runtime.kinematics.base import KinematicsError
from runtime.kinematics.compiled import CompiledKinematics, Config, build

ROBOT = load("agilex_piper")
KINEMATICS = CompiledKinematics(ROBOT)
HOME = ROBOT.poses["home"]
ARM_DIMS = np.concatenate([arm.joint_dims for arm in ROBOT.arms])


def inside_limits(q: np.ndarray) -> bool:
    return bool(((q >= ROBOT.lower) & (q <= ROBOT.upper))[..., ARM_DIMS].all())


def speed_share(q: np.ndarray, dt: float) -> float:
    """The largest joint speed between rows as a share of its limit."""
    return float((np.abs(np.diff(q, axis=0))[:, ARM_DIMS] / dt / ROBOT.velocity[ARM_DIMS]).max())


def within(share: np.ndarray) -> np.ndarray:
    return ROBOT.lower + share * (ROBOT.upper - ROBOT.lower)


shares = st.lists(st.floats(0, 1), min_size=14, max_size=14).map(np.array)
moves = st.lists(st.floats(-0.1, 0.1), min_size=14, max_size=14).map(np.array)


def test_forward_gives_each_arm_its_pose_for_rows_as_for_single_vectors() -> None:
    q = np.random.default_rng(0).uniform(ROBOT.lower, ROBOT.upper, (3, 2, 14))
    poses = KINEMATICS.forward(q)
    assert poses.shape == (3, 2, 2, 7)
    assert (poses[..., 3] >= 0).all()
    for index, arm in enumerate(ROBOT.arms):
        assert arm.chain is not None
        np.testing.assert_allclose(poses[1, 1, index], arm.chain.pose(q[1, 1, arm.joint_dims]), atol=1e-15)


@settings(max_examples=100, deadline=None)
@given(shares, moves)
def test_reachable_targets_near_the_seed_are_reached(share: np.ndarray, move: np.ndarray) -> None:
    seed = within(share)
    target = KINEMATICS.forward(np.clip(seed + move, ROBOT.lower, ROBOT.upper))[None]
    result = KINEMATICS.solve(target, seed)
    assert result.reached.all()
    assert inside_limits(result.q)


@settings(max_examples=50, deadline=None)
@given(shares, st.lists(st.floats(-2, 2), min_size=14, max_size=14))
def test_whatever_is_asked_joints_stay_in_limits_and_errors_are_those_of_the_joints(
    share: np.ndarray, numbers: list[float]
) -> None:
    targets = np.array(numbers).reshape(1, 2, 7)
    targets[..., 3] += 3.0  # a quaternion of some length, never zero
    result = KINEMATICS.solve(targets, within(share))
    assert inside_limits(result.q)
    found = KINEMATICS.forward(result.q)
    distance = np.linalg.norm(found[..., :3] - targets[..., :3], axis=-1)
    unit = targets[..., 3:] / np.linalg.norm(targets[..., 3:], axis=-1, keepdims=True)
    cosine = np.minimum(1.0, np.abs((found[..., 3:] * unit).sum(axis=-1)))
    np.testing.assert_allclose(result.position_error, distance, atol=1e-12)
    np.testing.assert_allclose(result.rotation_error, 2 * np.arccos(cosine), atol=1e-6)
    reached = (result.position_error <= 1e-3) & (result.rotation_error <= math.radians(0.5))
    np.testing.assert_array_equal(result.reached, reached)


def test_a_target_out_of_reach_is_reported_and_keeps_to_limits_and_speed() -> None:
    targets = np.repeat(KINEMATICS.forward(HOME)[None], 50, axis=0)
    targets[:, :, 0] += np.linspace(0, 1.5, 50)[:, None]
    result = KINEMATICS.solve(targets, HOME, 1 / 30)
    assert result.reached[0].all()
    assert not result.reached[-1].any()
    assert (result.position_error[-1] > 0.5).all()
    assert inside_limits(result.q)
    assert speed_share(result.q, 1 / 30) <= 1 + 1e-9


def test_the_home_pose_which_stands_on_two_limits_and_is_singular_holds_still() -> None:
    result = KINEMATICS.solve(np.repeat(KINEMATICS.forward(HOME)[None], 20, axis=0), HOME, 1 / 30)
    assert result.reached.all()
    np.testing.assert_allclose(result.q, np.zeros((20, 14)), atol=1e-9)


def test_a_path_out_of_the_singular_home_pose_is_followed_joint_by_joint() -> None:
    away = HOME.copy()
    away[[1, 2, 4, 8, 9, 11]] = [1.2, -1.0, 0.5, 0.8, -1.3, -0.4]
    path = HOME + np.linspace(0, 1, 50)[:, None] * (away - HOME)
    result = KINEMATICS.solve(KINEMATICS.forward(path), HOME, 1 / 30)
    assert result.reached.all()
    np.testing.assert_allclose(result.q, path, atol=1e-3)


def test_a_path_through_the_wrist_singularity_does_not_jump() -> None:
    start = np.array([0.1, 1.2, -1.0, 0.3, 0.4, 0.2, 0.0] * 2)
    end = np.array([0.2, 1.3, -1.1, 0.3, -0.4, 0.2, 0.0] * 2)
    path = start + np.linspace(0, 1, 60)[:, None] * (end - start)
    result = KINEMATICS.solve(KINEMATICS.forward(path), start, 1 / 30)
    assert result.reached.all()
    assert np.abs(np.diff(result.q, axis=0)).max() < 0.1


def test_a_jump_of_the_target_is_approached_no_faster_than_the_joints_may_move() -> None:
    there = np.array([1.0, 1.5, -1.5, 0.5, 0.5, 1.0, 0.0] * 2)
    near = np.array([0.2, 1.0, -1.0, 0.0, 0.3, 0.0, 0.0] * 2)
    poses = KINEMATICS.forward(np.stack([near] + [there] * 20))
    limited = KINEMATICS.solve(poses, near, 1 / 30)
    assert speed_share(limited.q, 1 / 30) <= 1 + 1e-9
    assert not limited.reached[1].any()
    assert limited.reached[-1].all()
    assert speed_share(KINEMATICS.solve(poses, near).q, 1 / 30) > 1.5


def test_a_seed_outside_the_limits_is_brought_inside() -> None:
    seed = HOME.copy()
    seed[[1, 2, 8, 9]] = [-0.002, 0.001, -0.3, 0.3]
    result = KINEMATICS.solve(KINEMATICS.forward(HOME)[None], seed, 1 / 30)
    assert inside_limits(result.q)
    assert result.reached.all()


def test_grippers_and_groups_without_an_end_effector_pass_through(tmp_path: Path) -> None:
    robot = one_armed(tmp_path)
    kinematics = CompiledKinematics(robot)
    seed = np.array([0.1, 0.2, -0.3, 0.4, 0.5, 0.6, 0.07, 0.2, 0.9, -0.8, 0.1, 0.2, 0.3, 0.05])
    moved = seed + 0.05 * np.array([1] * 13 + [0])
    result = kinematics.solve(np.repeat(kinematics.forward(moved)[None], 3, axis=0), seed)
    assert result.reached.shape == (3, 1)
    assert result.reached.all()
    np.testing.assert_array_equal(result.q[:, :7], np.repeat(seed[None, :7], 3, axis=0))
    np.testing.assert_array_equal(result.q[:, 13], [0.05] * 3)


def one_armed(tmp_path: Path) -> Robot:
    folder = tmp_path / "one_armed"
    shutil.copytree(ROBOT.folder, folder)
    file = folder / "robot.toml"
    arm = 'frame = "base_link"\neef_link = "gripper_base"\n'
    text = file.read_text()
    assert text.count(arm) == 2
    file.write_text(text.replace(arm, "", 1))
    return load(folder)


def test_tolerances_decide_what_counts_as_reached() -> None:
    target = KINEMATICS.forward(np.zeros(14))[None]
    target[0, :, 2] -= 0.02  # the arm stands on two limits and cannot follow
    strict = build(Config(), ROBOT).solve(target, HOME)
    lenient = build(Config(position_tolerance=0.05, rotation_tolerance=0.5), ROBOT).solve(target, HOME)
    assert not strict.reached.any()
    assert lenient.reached.all()
    np.testing.assert_array_equal(strict.q, lenient.q)


def test_the_same_question_has_the_same_answer() -> None:
    targets = KINEMATICS.forward(within(np.linspace(0.2, 0.8, 14)))[None]
    first, second = KINEMATICS.solve(targets, HOME), KINEMATICS.solve(targets, HOME)
    np.testing.assert_array_equal(first.q, second.q)


def test_quaternions_of_any_length_and_sign_mean_the_same() -> None:
    seed = within(np.full(14, 0.4))
    targets = KINEMATICS.forward(seed + 0.05)[None]
    other = targets.copy()
    other[..., 3:] *= -2.0
    np.testing.assert_allclose(KINEMATICS.solve(other, seed).q, KINEMATICS.solve(targets, seed).q, atol=1e-9)


def test_no_targets_give_no_joints() -> None:
    result = KINEMATICS.solve(np.empty((0, 2, 7)), HOME)
    assert result.q.shape == (0, 14)
    assert result.reached.shape == (0, 2)


@pytest.mark.parametrize(
    ("targets", "seed", "dt", "said"),
    [
        (np.ones((2, 7)), HOME, None, r"targets of shape \(2, 7\)"),
        (np.ones((1, 1, 7)), HOME, None, r"allowed: \[T, 2, 7\]"),
        (np.ones((1, 2, 7)), np.zeros(7), None, r"a seed of shape \(7,\) was given; allowed: \[14\]"),
        (np.ones((1, 2, 7)), HOME, 0.0, r"dt = 0\.0 s"),
        (np.ones((1, 2, 7)), HOME, math.nan, "dt = nan s"),
        (np.full((1, 2, 7), np.nan), HOME, None, "not finite"),
        (np.ones((1, 2, 7)), np.full(14, np.inf), None, "not finite"),
        (np.zeros((1, 2, 7)), HOME, None, "quaternion has length zero"),
    ],
)
def test_a_question_without_meaning_is_refused(
    targets: np.ndarray, seed: np.ndarray, dt: float | None, said: str
) -> None:
    with pytest.raises(KinematicsError, match=said):
        KINEMATICS.solve(targets, seed, dt)


def test_joints_of_another_width_are_refused() -> None:
    with pytest.raises(KinematicsError, match=r"allowed: \[\.\.\., 14\]"):
        KINEMATICS.forward(np.zeros(16))


@pytest.mark.skipif("EVA_SAMPLE_EPISODE" not in os.environ, reason="EVA_SAMPLE_EPISODE is not set")
def test_recorded_poses_of_both_arms_are_solved_close_to_the_recorded_joints() -> None:
    import pyarrow.parquet

    file = next(Path(os.environ["EVA_SAMPLE_EPISODE"]).glob("data/*/*.parquet"))
    table = pyarrow.parquet.read_table(file, columns=["observation.qpos", "observation.eef"])
    qpos, eef = (np.array(column.to_pylist(), dtype=np.float64) for column in table.columns)
    result = KINEMATICS.solve(eef.reshape(-1, 2, 8)[..., :7], qpos[0], 1 / 30)
    assert result.reached.all()
    assert np.abs(result.q - qpos)[:, ARM_DIMS].max() < 0.02
