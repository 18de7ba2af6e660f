from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from runtime.core.clock import VirtualClock
from runtime.core.errors import PolicyError
from runtime.core.types import Float64, Observation
from runtime.policies import mock
from runtime.policies.mock import Config, MockPolicy

RATE = 30.0


def policy(name: str = "agilex_piper", clock: VirtualClock | None = None, **settings: float) -> MockPolicy:
    return mock.build(Config.model_validate(settings), robots.load_robot(name), clock or VirtualClock(), RATE)


def observation(qpos: Float64, step: int = 0) -> Observation:
    return Observation(
        sequence=1, arrived=0.0, captured={}, qpos=qpos.astype(np.float32), pictures={}, step=step
    )


@given(st.sampled_from(robots.robot_names()), st.integers(0, 2**32 - 1), st.integers(0, 10_000))
def test_every_row_is_within_the_limits_wherever_the_robot_starts(name: str, seed: int, steps: int) -> None:
    robot = robots.load_robot(name)
    start = np.random.default_rng(seed).uniform(robot.lower, robot.upper)
    asked = policy(name, amplitude=1.0)
    asked.infer(observation(start, 5))
    rows = asked.infer(observation(start, 5 + steps)).actions
    slack = 1e-6 * np.maximum(1.0, np.abs(robot.upper))
    assert (rows >= robot.lower - slack).all()
    assert (rows <= robot.upper + slack).all()


def test_it_starts_at_rest_exactly_where_the_robot_is() -> None:
    robot = robots.load_robot("agilex_piper")
    start = np.clip(robot.poses["home"] + 0.01, robot.lower, robot.upper)
    rows = policy().infer(observation(start)).actions
    np.testing.assert_allclose(rows[0], start, atol=1e-6)
    assert np.abs(rows[1] - rows[0]).max() < 0.002


def test_it_moves_every_joint_visibly_and_comes_back() -> None:
    robot = robots.load_robot("agilex_piper")
    rows = policy(horizon=180, period_s=6.0).infer(observation(robot.poses["home"])).actions
    joints = np.setdiff1d(np.arange(robot.dim), robot.gripper_dims)
    assert np.ptp(rows, axis=0)[joints].min() > 0.19
    assert np.abs(rows[-1] - rows[0]).max() < 0.01


def test_binary_grippers_stay() -> None:
    for name in robots.robot_names():
        robot = robots.load_robot(name)
        rows = policy(name).infer(observation(robot.poses["home"])).actions
        assert np.ptp(rows[:, list(robot.binary_dims)], axis=0).tolist() == [0.0] * len(robot.binary_dims)


def test_chunks_of_different_steps_agree_on_the_same_target_step() -> None:
    start = robots.load_robot("agilex_piper").poses["home"]
    asked = policy()
    first = asked.infer(observation(start, 100)).actions
    later = asked.infer(observation(start + 0.05, 107)).actions
    np.testing.assert_array_equal(first[7:], later[:-7])


def test_reset_starts_anew_from_where_the_robot_is_now() -> None:
    robot = robots.load_robot("agilex_piper")
    elsewhere = np.clip(robot.poses["home"] + 0.05, robot.lower, robot.upper)
    asked = policy()
    asked.infer(observation(robot.poses["home"], 0))
    asked.reset()
    np.testing.assert_allclose(asked.infer(observation(elsewhere, 50)).actions[0], elsewhere, atol=1e-6)


def test_its_latency_passes_on_the_clock() -> None:
    clock = VirtualClock(10.0)
    policy(clock=clock, latency_s=0.25).infer(observation(robots.load_robot("agilex_piper").poses["home"]))
    assert clock.now() == 10.25


def test_it_says_what_it_is() -> None:
    info = policy(horizon=20).connect()
    assert (info.name, info.action_space, info.horizon) == ("mock", "joint", 20)


def test_it_refuses_joints_of_another_robot() -> None:
    with pytest.raises(PolicyError, match=r"\[7\]; agilex_piper has \[14\]"):
        policy().infer(observation(np.zeros(7)))


def test_its_module_loads_no_websocket_library() -> None:
    text = Path(mock.__file__).read_text()
    assert "websockets" not in text
