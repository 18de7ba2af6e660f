"""Arms on the bench are where the whole body has them."""

from __future__ import annotations

import numpy as np
import pytest

import robots
from robots import Body
from robots.rotations import transform_of
from runtime.simulation.bench.arm_frames import arm_frames

CASES = [(name, None) for name in robots.robot_names()] + [("r1_lite", ["left_arm", "right_arm", "torso"])]


@pytest.mark.parametrize(("name", "groups"), CASES)
def test_frames_end_effectors_and_shoulders_are_those_of_the_body(name, groups):
    robot = robots.load_robot(name, groups)
    body, chance = Body(robot), np.random.default_rng(1)
    for _ in range(5):
        q = chance.uniform(np.maximum(robot.lower, -3), np.minimum(robot.upper, 3))
        parts = body.poses(q)
        for arm in robot.arms:
            limb = arm_frames(robot)[arm.name]
            np.testing.assert_allclose(limb.eef(q), parts[body.link_of(arm.name, arm.eef_link)], atol=1e-9)
            np.testing.assert_allclose(limb.frame(q), parts[body.link_of(arm.name, arm.frame)], atol=1e-9)
            np.testing.assert_allclose(limb.tip(q), limb.eef(q) @ arm.tip, atol=1e-12)
            moved = q.copy()
            moved[arm.joint_dims] += 0.1
            np.testing.assert_allclose(limb.shoulder(moved)[:3, 3], limb.shoulder(q)[:3, 3], atol=1e-9)


def test_an_arm_on_a_body_that_moves_is_carried_along():
    robot = robots.load_robot("agibot_g2")
    arm, body = robot.arms[0], robot.group("body")
    q = robot.poses["home"].copy()
    before = arm_frames(robot)[arm.name].tip(q)
    q[body.slice.start + 4] += 0.2
    after = arm_frames(robot)[arm.name].tip(q)
    assert np.linalg.norm(after[:3, 3] - before[:3, 3]) > 0.03
    np.testing.assert_allclose(arm.pose(q), arm.pose(robot.poses["home"]), atol=1e-12)


def test_a_robot_that_stands_elsewhere_has_its_arms_there():
    robot = robots.load_robot("dual_franka")
    stand = transform_of(robot.stand)
    for arm in robot.arms:
        expected = stand @ transform_of(arm.mount)
        np.testing.assert_allclose(
            arm_frames(robot)[arm.name].frame(robot.poses["home"]), expected, atol=1e-12
        )


@pytest.mark.parametrize(("name", "upright"), [("agilex_piper", 1), ("ur5e", 1), ("dual_franka", 0)])
def test_it_is_known_whether_a_shoulder_turns_about_the_vertical(name, upright):
    robot = robots.load_robot(name)
    assert [limb.upright for limb in arm_frames(robot).values()] == [upright] * len(robot.arms)
    for arm, limb in zip(robot.arms, arm_frames(robot).values(), strict=True):
        q = robot.poses["home"].copy()
        before = limb.tip(q)
        q[arm.joint_dims[0]] += 0.1
        assert (abs(limb.tip(q)[2, 3] - before[2, 3]) < 1e-3) == bool(upright)
