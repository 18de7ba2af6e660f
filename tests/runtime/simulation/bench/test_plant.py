from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from runtime.simulation.bench.plant import Plant, poses


def plant(name: str = "agilex_piper") -> Plant:
    return Plant(robots.load_robot(name))


def test_it_starts_at_home_and_stays() -> None:
    robot = robots.load_robot("agilex_piper")
    standing = plant()
    standing.advance(1.0)
    np.testing.assert_array_equal(standing.q, robot.poses["home"])


@given(st.sampled_from(robots.robot_names()), st.integers(0, 1000), st.floats(0.001, 0.2))
def test_no_joint_is_ever_faster_than_its_limit_nor_beyond_its_target(
    name: str, seed: int, seconds: float
) -> None:
    robot = robots.load_robot(name)
    moving = Plant(robot)
    moving.target = np.random.default_rng(seed).uniform(robot.lower, robot.upper)
    before = moving.q
    moving.advance(seconds)
    step = moving.q - before
    assert (np.abs(step) <= robot.velocity * seconds + 1e-12).all()
    assert (np.abs(step) <= np.abs(moving.target - before) + 1e-12).all()


def test_it_arrives() -> None:
    moving = plant()
    moving.target = np.clip(moving.q + 0.3, moving.target - 1, robots.load_robot("agilex_piper").upper)
    for _ in range(60):
        moving.advance(1 / 30)
    np.testing.assert_allclose(moving.q, moving.target, atol=1e-6)


def test_a_small_way_is_covered_with_its_time_constant() -> None:
    moving = Plant(robots.load_robot("agilex_piper"), lag=0.1)
    moving.target[0] = 0.01
    for _ in range(10):
        moving.advance(0.01)
    assert moving.q[0] == pytest.approx(0.01 * (1 - np.exp(-1.0)))


def test_holding_forgets_the_target() -> None:
    moving = plant()
    moving.target[0] = 1.0
    moving.advance(0.02)
    moving.hold()
    place = moving.q.copy()
    moving.advance(1.0)
    np.testing.assert_array_equal(moving.q, place)
    assert 0 < place[0] < 1.0


@pytest.mark.parametrize("name", robots.robot_names())
def test_poses_are_those_of_the_chain_with_the_gripper_last(name: str) -> None:
    robot = robots.load_robot(name)
    q = 0.5 * (robot.lower + robot.upper)
    found = poses(robot, q)
    assert list(found) == [arm.name for arm in robot.arms]
    for arm in robot.arms:
        assert arm.chain is not None
        np.testing.assert_allclose(found[arm.name][:7], arm.chain.pose(q[arm.joint_dims]), atol=1e-6)
        assert found[arm.name][7] == np.float32(q[arm.gripper_dim])
        assert found[arm.name].dtype == np.float32
