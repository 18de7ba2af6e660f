"""What becomes of the joints that a pose leaves open, and of paths that joints are known to have."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.ik_paths import arm_dims, invented
from benchmarks.ik_postures import LOOPS, PATHS, SETTLED, drift, path, worst
from robots import Robot, load_robot, robot_names
from runtime.kinematics.base import IkFlag, IkResult
from runtime.kinematics.compiled import CompiledKinematics, Config
from tests.examples import some

SEVEN = ("dual_franka", "agibot_g2")


@cache
def robot_of(name: str) -> tuple[Robot, CompiledKinematics]:
    robot = load_robot(name)
    return robot, CompiledKinematics(robot)


def moved(robot: Robot, by: float) -> tuple[np.ndarray, np.ndarray]:
    """Home with every elbow turned about the line from shoulder to hand, and the poses, which are home's."""
    _, kinematics = robot_of(robot.name)
    home = robot.poses["home"]
    q = home.copy()
    for arm in robot.arms:
        assert arm.chain is not None
        for _ in range(100):
            null = np.linalg.svd(arm.chain.jacobian(q[arm.joint_dims])[1])[2][-1]
            q[arm.joint_dims] += by / 100 * null * np.sign(null[0])
    poses = kinematics.forward(home)[None]
    return kinematics.solve(poses, q).q[0], poses


@pytest.mark.parametrize("name", SEVEN)
def test_a_circle_at_home_closes_in_the_joints_as_well(name: str) -> None:
    loops = drift(*robot_of(name))
    assert loops.shape == (3, LOOPS)
    assert loops[:, SETTLED:].max() < 1e-3
    assert loops[:, 0].max() < 0.2  # from home to where the circle is gone round


def test_without_a_rate_the_joints_drift() -> None:
    robot, _ = robot_of("dual_franka")
    assert drift(robot, CompiledKinematics(robot, Config(home_rate=0.0)))[:, SETTLED:].max() > 0.005


@pytest.mark.parametrize("name", SEVEN)
def test_an_arm_that_was_led_to_another_posture_goes_home_while_its_hand_stays(name: str) -> None:
    robot, kinematics = robot_of(name)
    dims, home = arm_dims(robot), robot.poses["home"]
    start, poses = moved(robot, 0.5)
    assert np.abs(start - home)[dims].max() > 0.15
    result = kinematics.solve(np.repeat(poses, 200, axis=0), start, 1 / 30, start, 0)
    assert result.position_error.max() < 1e-5
    assert np.abs(result.q[-1] - home)[dims].max() < 1e-3
    steps = np.abs(np.diff(np.concatenate([start[None], result.q]), axis=0))[:, dims]
    assert (steps * 30 <= 0.21 * robot.velocity[dims]).all()


@pytest.mark.parametrize("name", SEVEN)
def test_a_path_in_chunks_is_the_same_as_in_one(name: str) -> None:
    robot, kinematics = robot_of(name)
    start, poses = moved(robot, 0.5)
    targets = np.repeat(poses, 60, axis=0)
    whole = kinematics.solve(targets, start, 1 / 30, start, 0).q
    first = kinematics.solve(targets[:20], start, 1 / 30, start, 0).q
    then = kinematics.solve(targets[20:], first[-1], 1 / 30, first[-1], 0).q
    np.testing.assert_allclose(np.concatenate([first, then]), whole, atol=1e-3)


@pytest.mark.parametrize("dt", [0.002, 0.033, 0.5, 3.0])
def test_rows_of_any_length_lead_home_without_swinging(dt: float) -> None:
    robot, kinematics = robot_of("dual_franka")
    dims = arm_dims(robot)
    start, poses = moved(robot, 0.4)
    result = kinematics.solve(np.repeat(poses, 40, axis=0), start, dt, start, 0)
    away = np.abs(result.q - robot.poses["home"])[:, dims].max(axis=1)
    assert (np.diff(away) < 1e-4).all()
    assert result.position_error.max() < 1e-4


def test_a_question_without_time_leaves_the_posture_as_it_is() -> None:
    robot, kinematics = robot_of("dual_franka")
    start, poses = moved(robot, 0.5)
    np.testing.assert_allclose(kinematics.solve(np.repeat(poses, 5, axis=0), start).q[-1], start, atol=1e-4)


@pytest.mark.exhaustive
def test_six_joints_have_no_choice_and_are_as_without_a_home() -> None:
    for name in ("agilex_piper", "ur5e"):
        robot, kinematics = robot_of(name)
        free = CompiledKinematics(robot, Config(home_rate=0.0))
        for chunk in invented(robot)["through"]:
            asked = (chunk.targets, chunk.seed, chunk.dt, chunk.seed, 0)
            np.testing.assert_array_equal(kinematics.solve(*asked).q, free.solve(*asked).q)


@pytest.mark.parametrize("name", robot_names())
def test_a_long_path_that_joints_have_is_missed_by_no_arm(name: str) -> None:
    robot, kinematics = robot_of(name)
    off = np.array([worst(robot, kinematics, path(robot, number)) for number in range(PATHS)])
    assert off.max() <= 1e-3


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", robot_names())
def test_a_smooth_path_is_met_within_ten_micrometres(name: str) -> None:
    robot, kinematics = robot_of(name)
    for chunk in invented(robot)["smooth"]:
        result = kinematics.solve(chunk.targets, chunk.seed, chunk.dt, chunk.seed, 0)
        assert result.position_error.max() <= 1e-5
        assert np.degrees(result.rotation_error.max()) < 0.02
        assert not (result.flags & (IkFlag.AT_LIMIT | IkFlag.AT_VELOCITY)).any()


def held_to(robot: Robot, result: IkResult, anchor: np.ndarray, row: int, dt: float) -> None:
    dims = arm_dims(robot)
    own = result.q[:, dims]
    assert ((own >= robot.lower[dims]) & (own <= robot.upper[dims])).all()
    before = np.clip(anchor, robot.lower, robot.upper)[None, dims]
    steps = np.abs(np.diff(np.concatenate([before, own[row:]]), axis=0))
    assert (steps <= robot.velocity[dims] * dt).all()
    still = np.setdiff1d(np.arange(robot.dim), dims)
    assert (result.q[:, still] == result.q[0, still]).all()


@settings(max_examples=some(60))
@given(st.sampled_from(robot_names()), st.integers(0, 10_000), st.integers(0, 12), st.floats(0.0, 0.5))
def test_whatever_is_planned_anew_keeps_to_limits_and_velocities(
    name: str, number: int, row: int, off: float
) -> None:
    """Far paths, many of which are missed at first, from commands beside them."""
    robot, kinematics = robot_of(name)
    joints = path(robot, number, 2, np.inf)[:120]
    chance = np.random.default_rng(number)
    anchor = joints[row].copy()
    anchor[arm_dims(robot)] += chance.uniform(-off, off, len(arm_dims(robot)))
    targets, dt = kinematics.forward(joints), 1 / robot.control_rate
    result = kinematics.solve(targets, joints[0], dt, anchor, row)
    held_to(robot, result, anchor, row, dt)
    found = kinematics.forward(result.q)
    away = np.linalg.norm(found[..., :3] - targets[..., :3], axis=-1)
    np.testing.assert_allclose(result.position_error, away, atol=1e-9)
