from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from runtime.simulation.bench.plant import Plant
from runtime.simulation.scripts.gestures import Gesture

RATE = 30.0


@given(st.sampled_from(robots.robot_names()), st.integers(0, 1000))
def test_a_chunk_starts_where_the_robot_is_and_is_slow_and_within_limits(name: str, seed: int) -> None:
    robot = robots.load_robot(name)
    start = np.random.default_rng(seed).uniform(robot.lower, robot.upper)
    rows = Gesture(robot).chunk(start, 50, RATE).astype(np.float64)
    steps = np.diff(np.vstack([start, rows]), axis=0)
    slack = 1e-5 * np.maximum(1.0, np.abs(robot.upper))
    joints = np.setdiff1d(np.arange(robot.dim), robot.gripper_dims)
    assert np.abs(steps[:, joints]).max() * RATE < 1.0
    moves = np.setdiff1d(np.arange(robot.dim), robot.binary_dims)  # what switches does so in one row
    assert (np.abs(steps) <= robot.velocity / RATE + slack)[:, moves].all()
    assert (rows >= robot.lower - slack).all()
    assert (rows <= robot.upper + slack).all()


def test_the_same_joints_give_the_same_chunk() -> None:
    robot = robots.load_robot("agilex_piper")
    start = 0.3 * robot.lower + 0.7 * robot.upper
    np.testing.assert_array_equal(
        Gesture(robot).chunk(start, 20, RATE), Gesture(robot).chunk(start, 20, RATE)
    )


@pytest.mark.parametrize("name", robots.robot_names())
def test_a_robot_that_follows_it_goes_round_for_ever(name: str) -> None:
    robot = robots.load_robot(name)
    gesture, plant = Gesture(robot), Plant(robot)
    phases, joints = [], []
    for _ in range(90):
        rows = gesture.chunk(plant.q, 10, RATE).astype(np.float64)
        for row in rows[:6]:
            plant.target = row
            plant.advance(1 / RATE)
            joints.append(plant.q)
        phases.append(gesture.phase_of(plant.q))
    turns = np.unwrap(phases)
    assert turns[-1] - turns[0] > 2 * np.pi
    late = np.array(joints)[270:]
    moving = np.concatenate([arm.joint_dims for arm in robot.arms])
    assert (np.ptp(late, axis=0)[moving] > 0.1 * np.minimum(0.5, (robot.upper - robot.lower)[moving])).all()
    assert (np.ptp(late, axis=0)[list(robot.gripper_dims)] > 0).all()


def test_what_is_no_arm_stays_where_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "with_head"
    shutil.copytree(robots.load_robot("agilex_piper").folder, folder)
    file = folder / "robot.toml"
    head = '[[groups]]\nname = "head"\njoints = ["pan"]\nurdf_joints = ["joint7"]\n\n[poses.home]\n'
    text = file.read_text().replace("[poses.home]\n", head)
    file.write_text(re.sub(r"(right_arm = .*\n)", r"\1head = [0.01]\n", text))
    robot = robots.load_robot(folder)
    start = 0.5 * (robot.lower + robot.upper)
    rows = Gesture(robot).chunk(start, 30, RATE)
    part = robot.group("head").slice
    np.testing.assert_allclose(rows[:, part], np.tile(start[part], (30, 1)), atol=1e-6)
    assert np.ptp(rows[:, 0]) > 0.1


@given(st.floats(-3.0, 3.0))
def test_the_phase_can_be_read_off_the_joints(phase: float) -> None:
    robot = robots.load_robot("agilex_piper")
    gesture = Gesture(robot)
    assert gesture.phase_of(gesture.joints_at(phase, robot.poses["home"])) == pytest.approx(phase, abs=1e-6)
