"""How far jaws are open, whatever number says it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import robots
from runtime.simulation.bench.bench import Bench, BenchError
from runtime.simulation.bench.hands import Jaws, Opening

GRIPPERS = [(name, arm) for name in robots.robot_names() for arm in robots.load_robot(name).arms]


@pytest.mark.parametrize(("name", "arm"), GRIPPERS, ids=[f"{name}-{arm.name}" for name, arm in GRIPPERS])
def test_open_and_close_are_as_far_apart_as_declared_and_the_block_fits_between(name, arm):
    opening = Opening(arm.gripper)
    closed, opened = arm.gripper.apart
    assert opening.metres(arm.gripper.close) == pytest.approx(closed)
    assert opening.metres(arm.gripper.open) == pytest.approx(opened)
    assert closed < 0.75 * Bench().block_edge < 1.5 * Bench().block_edge < opened
    for metres in (closed, 0.04, opened):
        assert opening.metres(opening.number(metres)) == pytest.approx(metres)


def test_a_number_that_rises_as_the_jaws_close_is_turned_round():
    gripper = replace(
        robots.load_robot("agilex_piper").arms[0].gripper, open=0.0, close=2.0, apart=(0.01, 0.05)
    )
    assert [Opening(gripper).metres(number) for number in (0.0, 1.0, 2.0)] == pytest.approx(
        [0.05, 0.03, 0.01]
    )


@pytest.mark.parametrize(("name", "arm"), GRIPPERS, ids=[f"{name}-{arm.name}" for name, arm in GRIPPERS])
def test_what_is_between_the_jaws_holds_them_apart(name, arm):
    robot = robots.load_robot(name)
    jaws, q = Jaws(robot, arm), robot.poses["ready"].copy()
    jaws.stop(q, 0.04)
    assert jaws.hand(q, None, 0.0).opening == pytest.approx(0.04)
    others = np.delete(np.arange(robot.dim), arm.gripper_dim)
    np.testing.assert_array_equal(q[others], robot.poses["ready"][others])


def test_an_arm_without_gripper_has_no_jaws():
    robot = robots.load_robot("agilex_piper")
    with pytest.raises(BenchError, match="group left_arm has no gripper; allowed: an arm with one"):
        Jaws(robot, replace(robot.arms[0], gripper=None))
