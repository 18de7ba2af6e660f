"""The compiled kinematics, judged by the robots' chains and by an optimiser of another make."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from robots import Robot, load_robot, robot_names
from robots.rotations import transform_of
from runtime.kinematics import kernel_cache
from runtime.kinematics.base import IkFlag, IkResult, KinematicsError
from runtime.kinematics.compiled import CompiledKinematics, Config, build
from runtime.kinematics.kernels.chunk_solver import solve_chunk
from runtime.kinematics.kernels.forward_kinematics import compute_poses
from tests.examples import some
from tests.runtime.kinematics.crane import crane
from tests.sources import ROOT

ROBOT = load_robot("agilex_piper")
KINEMATICS = CompiledKinematics(ROBOT)
HOME = ROBOT.poses["home"]
ARM_DIMS = np.concatenate([arm.joint_dims for arm in ROBOT.arms])


def inside_limits(q: np.ndarray) -> bool:
    return bool(((q >= ROBOT.lower) & (q <= ROBOT.upper))[..., ARM_DIMS].all())


def speed_share(q: np.ndarray, dt: float) -> float:
    """The largest joint speed between rows as a share of its limit."""
    return float((np.abs(np.diff(q, axis=0))[:, ARM_DIMS] / dt / ROBOT.velocity[ARM_DIMS]).max())


@pytest.fixture(scope="module")
def lifting(tmp_path_factory: pytest.TempPathFactory) -> tuple[Robot, CompiledKinematics]:
    robot = crane(tmp_path_factory.mktemp("crane"))
    return robot, build(Config(), robot)


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


@settings(max_examples=some(100))
@given(shares, moves)
def test_reachable_targets_near_the_seed_are_reached(share: np.ndarray, move: np.ndarray) -> None:
    seed = within(share)
    target = KINEMATICS.forward(np.clip(seed + move, ROBOT.lower, ROBOT.upper))[None]
    result = KINEMATICS.solve(target, seed)
    assert result.reached.all()
    assert inside_limits(result.q)


@settings(max_examples=some(50))
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
    return load_robot(folder)


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


# Arms of any make


@pytest.mark.parametrize("name", robot_names())
def test_forward_is_what_the_chains_of_every_robot_say(name: str) -> None:
    robot = load_robot(name)
    q = np.random.default_rng(1).uniform(
        np.maximum(robot.lower, -9), np.minimum(robot.upper, 9), (20, robot.dim)
    )
    expected = np.stack([arm.pose(q) for arm in robot.arms], axis=1)
    np.testing.assert_allclose(CompiledKinematics(robot).forward(q), expected, atol=1e-14)


@pytest.mark.exhaustive  # its kernels are compiled anew
def test_carried_sliding_endless_and_mimicking_joints_are_followed(
    lifting: tuple[Robot, CompiledKinematics],
) -> None:
    robot, kinematics = lifting
    home = robot.poses["home"]
    poses = kinematics.forward(home)
    for index, arm in enumerate(robot.arms):
        assert arm.carrier is not None
        np.testing.assert_allclose(poses[index], arm.pose(home), atol=1e-14)
    away = home + np.array([3.0, -0.3, 0.15, 0.4, -0.5, 0.3, 0.4, 0, 0, 0.5, -0.4, 0.3, 0.6])
    way = home + np.linspace(0, 1, 90)[:, None] * (away - home)
    result = kinematics.solve(kinematics.forward(way), home, 1 / 50)
    assert result.reached.all()
    assert result.position_error.max() < 5e-5
    np.testing.assert_array_equal(result.q[:, 7:9], np.tile(home[7:9], (90, 1)))
    assert (np.abs(np.diff(result.q, axis=0)) * 50 <= robot.velocity).all()
    np.testing.assert_allclose(result.q[:, 9:], way[:, 9:], atol=1e-4)  # four joints have no choice


@pytest.mark.exhaustive  # its kernels are compiled anew
def test_what_carries_an_arm_stands_as_in_the_seed(lifting: tuple[Robot, CompiledKinematics]) -> None:
    robot, kinematics = lifting
    home = robot.poses["home"]
    raised = home.copy()
    raised[7:9] += [0.2, -0.4]
    result = kinematics.solve(kinematics.forward(raised)[None], raised)
    np.testing.assert_allclose(result.q[0], raised, atol=1e-9)
    assert result.reached.all()


@pytest.mark.exhaustive  # its kernels are compiled anew
@settings(max_examples=some(40))
@given(st.integers(0, 2**32 - 1))
def test_errors_and_flags_are_those_of_the_joints_that_are_returned(
    lifting: tuple[Robot, CompiledKinematics], seed: int
) -> None:
    robot, kinematics = lifting
    chance = np.random.default_rng(seed)
    low, high = np.maximum(robot.lower, -6), np.minimum(robot.upper, 6)
    start = chance.uniform(low, high)
    targets = kinematics.forward(np.clip(start + chance.normal(0, 0.4, robot.dim).cumsum(), low, high))[None]
    targets = np.repeat(targets, 6, axis=0)
    targets[:, :, :3] += chance.normal(0, 0.05, (6, 2, 3))
    result = kinematics.solve(targets, start, 1 / 50)
    judge(robot, result, targets, start, 1 / 50)


def judge(robot: Robot, result: IkResult, targets: np.ndarray, seed: np.ndarray, dt: float) -> None:
    """Compares errors and flags with what chains, a singular value decomposition and differences say."""
    for index, arm in enumerate(robot.arms):
        assert arm.chain is not None
        dims = arm.joint_dims
        own = result.q[:, dims]
        apart = Rotation.from_matrix(
            transform_of(targets[:, index])[:, :3, :3] @ np.swapaxes(arm.transform(result.q)[:, :3, :3], 1, 2)
        ).magnitude()
        away = np.linalg.norm(arm.transform(result.q)[:, :3, 3] - targets[:, index, :3], axis=1)
        np.testing.assert_allclose(result.position_error[:, index], away, atol=1e-12)
        np.testing.assert_allclose(result.rotation_error[:, index], apart, atol=1e-7)
        flags = result.flags[:, index]
        over = (away > 1e-3) | (apart > math.radians(0.5))
        np.testing.assert_array_equal(flags & IkFlag.OVER_TOLERANCE != 0, over)
        at_limit = ((own <= robot.lower[dims]) | (own >= robot.upper[dims])).any(axis=1)
        np.testing.assert_array_equal(flags & IkFlag.AT_LIMIT != 0, at_limit)
        speed = np.abs(np.diff(own, axis=0)) / dt / robot.velocity[dims]
        assert (speed <= 1).all()
        np.testing.assert_array_equal(flags[1:] & IkFlag.AT_VELOCITY != 0, (speed > 1 - 1e-6).any(axis=1))
        assert not flags[0] & IkFlag.AT_VELOCITY
        smallest = [np.linalg.svd(arm.chain.jacobian(row)[1], compute_uv=False)[-1] for row in own]
        np.testing.assert_array_equal(flags & IkFlag.NEAR_SINGULAR != 0, np.array(smallest) < 0.02)


@pytest.mark.some(2)
@pytest.mark.parametrize("off", [0.0, 0.02, 0.6])
@pytest.mark.parametrize("chance", range(5))
def test_another_optimiser_finds_nothing_cheaper_nearby(off: float, chance: int) -> None:
    """scipy's trust region in the same box from the same start; `off` metres beyond what can be reached."""
    numbers = np.random.default_rng(chance)
    seed = within(numbers.uniform(0.3, 0.7, 14))
    target = KINEMATICS.forward(seed + numbers.normal(0, 0.1, 14))[None]
    target[0, :, :3] += off * numbers.normal(0, 1, 3)
    found = KINEMATICS.solve(target, seed).q[0]
    for index, arm in enumerate(ROBOT.arms):
        assert arm.chain is not None
        dims, goal, chain = arm.joint_dims, transform_of(target[0, index]), arm.chain

        def residual(q: np.ndarray, goal=goal, chain=chain, rest=seed[dims]) -> np.ndarray:  # type: ignore[no-untyped-def]
            tip = chain.forward(q)
            turned = Rotation.from_matrix(tip[:3, :3] @ goal[:3, :3].T).as_rotvec()
            return np.concatenate([50 * (tip - goal)[:3, 3], 10 * turned, 0.02 * (q - rest)])

        box = ROBOT.lower[dims], ROBOT.upper[dims]
        theirs = least_squares(residual, seed[dims], bounds=box, xtol=1e-12, ftol=1e-12, gtol=1e-12)
        ours = float(np.sum(residual(found[dims]) ** 2))
        assert ours <= 2 * theirs.cost * 1.01 + 1e-8


# The anchor, and what velocities count from


def test_the_row_that_is_executed_first_is_bound_to_what_is_commanded_before_it() -> None:
    seed = within(np.full(14, 0.5))
    path = seed + np.linspace(0, 0.3, 20)[:, None] * np.where(ROBOT.velocity == 1.0, 0, 1)
    anchor = path[7] + np.where(ROBOT.velocity == 1.0, 0, 0.25)  # the robot was led elsewhere meanwhile
    result = KINEMATICS.solve(KINEMATICS.forward(path), seed, 1 / 30, anchor, 8)
    np.testing.assert_allclose(result.q[:8], path[:8], atol=1e-3)
    way = np.abs(result.q[8] - anchor)[ARM_DIMS] * 30 / ROBOT.velocity[ARM_DIMS]
    assert 0.9 < way.max() <= 1
    assert speed_share(result.q[8:], 1 / 30) <= 1
    assert (result.flags[8] & IkFlag.AT_VELOCITY).all()
    assert result.reached[-1].all()


def test_rows_before_the_anchor_are_bound_by_joint_limits_alone() -> None:
    seed, there = within(np.full(14, 0.4)), within(np.full(14, 0.5))
    targets = KINEMATICS.forward(np.stack([seed, there, there, there]))
    stale = KINEMATICS.solve(targets, seed, 1 / 30, there, 3)
    assert stale.reached.all()
    assert speed_share(stale.q[:3], 1 / 30) > 1.5
    executed = KINEMATICS.solve(targets, seed, 1 / 30)
    assert speed_share(executed.q, 1 / 30) <= 1
    assert not executed.reached[1].any()


def test_an_anchor_at_row_0_binds_the_first_row_which_is_free_without_one() -> None:
    seed, there = within(np.full(14, 0.4)), within(np.full(14, 0.5))
    targets = KINEMATICS.forward(there)[None]
    assert KINEMATICS.solve(targets, seed, 1 / 30).reached.all()
    bound = KINEMATICS.solve(targets, seed, 1 / 30, seed, 0)
    assert not bound.reached.any()
    assert (np.abs(bound.q[0] - seed)[ARM_DIMS] * 30 <= ROBOT.velocity[ARM_DIMS]).all()
    assert KINEMATICS.solve(targets, seed, 1 / 30, seed, 5).reached.all()  # which no row of the chunk is


def test_a_part_of_the_velocities_may_be_kept_back() -> None:
    seed, there = within(np.full(14, 0.4)), within(np.full(14, 0.6))
    kinematics = build(Config(velocity_scale=0.25), ROBOT)
    result = kinematics.solve(KINEMATICS.forward(np.stack([seed, *[there] * 9])), seed, 1 / 30)
    assert 0.2499 < speed_share(result.q, 1 / 30) <= 0.25


def test_a_great_rest_weight_holds_the_arm_back_from_its_targets() -> None:
    seed = within(np.full(14, 0.5))
    targets = KINEMATICS.forward(seed + 0.1)[None]
    heavy = build(Config(rest_weight=1.0), ROBOT).solve(targets, seed)
    light = build(Config(rest_weight=0.0), ROBOT).solve(targets, seed)
    assert heavy.position_error.min() > 20 * light.position_error.max()
    assert light.reached.all()


# What compiling costs, and when


def test_nothing_is_compiled_once_a_robot_is_built_whatever_the_arrays_are() -> None:
    kinematics = build(Config(), ROBOT)
    known = len(solve_chunk.signatures), len(compute_poses.signatures)  # type: ignore[attr-defined]
    seed = within(np.full(14, 0.5))
    targets = KINEMATICS.forward(np.stack([seed] * 4))
    expected = kinematics.solve(targets, seed).q
    frozen, single = seed.copy(), targets.astype(np.float32)
    frozen.setflags(write=False)
    assert not ROBOT.poses["home"].flags.writeable
    for given_targets, given_seed in (
        (np.repeat(targets, 2, axis=2)[..., ::2], frozen),
        (np.asfortranarray(targets), np.repeat(seed, 3)[::3]),
        (targets.tolist(), seed.tolist()),
    ):
        np.testing.assert_array_equal(kinematics.solve(given_targets, given_seed).q, expected)  # type: ignore[arg-type]
    kinematics.solve(single, seed.astype(np.float32), np.float32(0.1), ROBOT.poses["home"], np.int64(1))  # type: ignore[arg-type]
    kinematics.forward(ROBOT.poses["home"])
    assert (len(solve_chunk.signatures), len(compute_poses.signatures)) == known  # type: ignore[attr-defined]


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, check=True
    )


def test_a_deployment_is_read_without_numba() -> None:
    code = "import sys, runtime.config.schema, runtime.kinematics.links; print('numba' in sys.modules)"
    assert python(code).stdout.strip() == "False"


def test_where_numba_is_missing_the_error_says_what_to_do() -> None:
    code = """if True:
        import sys, robots
        sys.modules["numba"] = None
        from runtime.core.errors import SetupError
        from runtime.kinematics.compiled import Config, build
        try:
            build(Config(), robots.load_robot("agilex_piper"))
        except SetupError as error:
            print(error)
    """
    assert "numba, which is not installed: pip install numba" in python(code).stdout


@pytest.mark.exhaustive
def test_without_a_folder_to_write_kernels_are_kept_in_memory_and_that_is_said(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()  # nobody can make a folder below a file, not even root
    code = """if True:
        import numpy as np, robots
        from runtime.kinematics.links import LinkPoses
        from runtime.kinematics.kernels.compilation import CACHE
        print(CACHE, LinkPoses(robots.Body(robots.load_robot("agilex_piper"))).poses(np.zeros(14)).shape[1:])
    """
    done = python(code, NUMBA_CACHE_DIR=str(file / "below"))
    assert done.stdout.startswith("None (")
    assert "name a folder in NUMBA_CACHE_DIR" in done.stderr


@pytest.mark.exhaustive
def test_kernels_are_kept_in_the_folder_that_is_named(tmp_path: Path) -> None:
    code = """if True:
        import robots
        from runtime.kinematics.links import LinkPoses
        LinkPoses(robots.Body(robots.load_robot("agilex_piper")))
    """
    python(code, NUMBA_CACHE_DIR=str(tmp_path))
    assert [path.suffix for path in sorted(tmp_path.glob("kernels-*/*/*"))] == [".nbc", ".nbi"]


def test_that_something_has_to_be_compiled_is_said_before(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(kernel_cache, "is_compiled", lambda robot: False)
    with caplog.at_level("INFO"):
        build(Config(), ROBOT)
    assert "compiling the kinematics for this processor, once" in caplog.text


@pytest.mark.exhaustive
def test_what_is_kept_on_disk_and_broken_is_compiled_again(tmp_path: Path) -> None:
    code = (
        "import logging, robots; logging.basicConfig(level='INFO'); from runtime.kinematics import compiled; "
        "compiled.build(compiled.Config(), robots.load_robot('ur5e'))"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    build(Config(), load_robot("ur5e"))  # so that it is kept
    kept_at = kernel_cache.folder()
    assert kept_at is not None
    shutil.copytree(kept_at, tmp_path / kept_at.name)

    def started() -> str:
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        )
        return done.stderr

    kept = sorted(tmp_path.rglob("*.nbc"))
    assert kept
    assert started() == ""
    for file in kept:
        file.write_bytes(file.read_bytes()[:100])
    assert "cannot be used as they are kept" in started()
    assert started() == ""
