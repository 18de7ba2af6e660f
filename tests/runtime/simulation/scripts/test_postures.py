from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import robots
from runtime.core.errors import SetupError
from runtime.simulation.bench.bench import Bench, tip_in_world
from runtime.simulation.scripts.postures import (
    CLEAR,
    TILTS,
    Postures,
    closed,
    gripper_dim,
    jaws,
    opened,
)

ROBOT = robots.load_robot("agilex_piper")
LEFT, RIGHT = ROBOT.arms
READY, HOME = ROBOT.poses["ready"], ROBOT.poses["home"]
POSTURES = Postures(ROBOT, Bench())
BLOCK, PLATE = (-0.1, 0.26, 0.4), (-0.05, 0.38)


def test_fingertips_hover_where_they_are_asked_to_with_open_jaws():
    q = POSTURES.hover(LEFT, HOME, PLATE, 0.05)
    assert q is not None
    tip = tip_in_world(ROBOT, LEFT, q)
    np.testing.assert_allclose(tip[:3, 3], [*PLATE, 0.05], atol=1e-3)
    assert -tip[2, 2] == pytest.approx(math.cos(TILTS[0][1]), abs=0.01)
    assert q[gripper_dim(LEFT)] == pytest.approx(0.95 * jaws(LEFT).open + 0.05 * jaws(LEFT).close)
    np.testing.assert_array_equal(q[RIGHT.slice], HOME[RIGHT.slice])


def test_what_is_out_of_reach_has_no_posture():
    assert POSTURES.hover(LEFT, HOME, (0.0, 0.9), 0.05) is None
    assert POSTURES.stations(LEFT, HOME, (0.0, 0.9, 0.0), PLATE, 0.0, TILTS[0]) == (None, None)
    down, over = POSTURES.stations(LEFT, HOME, BLOCK, (0.0, 0.9), 0.0, TILTS[0])
    assert down is not None
    assert over is None


def test_the_stations_go_straight_down_on_block_and_plate():
    down, over = POSTURES.stations(LEFT, READY, BLOCK, PLATE, 0.0, TILTS[0])
    for way, place in ((down, BLOCK[:2]), (over, PLATE)):
        tips = np.stack([tip_in_world(ROBOT, LEFT, q)[:3, 3] for q in way])
        np.testing.assert_allclose(tips[:, :2], np.broadcast_to(place, (4, 2)), atol=2e-3)
        assert tips[0, 2] == pytest.approx(CLEAR, abs=2e-3)
        assert np.all(np.diff(tips[:, 2]) < 0)


def test_an_arm_that_is_low_rises_where_it_is_and_one_that_is_high_stays():
    low = POSTURES.hover(LEFT, HOME, PLATE, 0.02)
    risen = POSTURES.risen(LEFT, low)
    np.testing.assert_allclose(tip_in_world(ROBOT, LEFT, risen)[:3, 3], [*PLATE, CLEAR], atol=2e-3)
    np.testing.assert_array_equal(POSTURES.risen(LEFT, READY), READY)


def test_an_arm_rests_as_the_robot_does_when_it_is_ready():
    q = POSTURES.rested(LEFT, HOME)
    np.testing.assert_array_equal(q[list(LEFT.joint_dims)], READY[list(LEFT.joint_dims)])
    np.testing.assert_array_equal(q[RIGHT.slice], HOME[RIGHT.slice])


def test_jaws_open_and_close_nearly_as_far_as_they_go():
    way = jaws(LEFT).open - jaws(LEFT).close
    rows = np.stack([HOME, READY])
    dim = gripper_dim(LEFT)
    np.testing.assert_allclose(opened(LEFT, rows)[:, dim] - jaws(LEFT).close, 0.95 * way)
    np.testing.assert_allclose(closed(LEFT, rows)[:, dim] - jaws(LEFT).close, 0.05 * way)
    others = np.delete(np.arange(ROBOT.dim), dim)
    np.testing.assert_array_equal(opened(LEFT, rows)[:, others], rows[:, others])


def test_an_arm_that_does_not_say_how_far_it_opens_cannot_pick_and_leaves_it_to_the_other():
    one = replace(ROBOT, groups=(mute(LEFT), RIGHT))
    assert [arm.name for arm in Postures(one, Bench()).arms] == ["right_arm"]
    neither = replace(ROBOT, groups=tuple(mute(one) for one in ROBOT.groups))
    with pytest.raises(
        SetupError, match=r"agilex_piper cannot pick things up: left_arm needs .*\(apart\); right_arm"
    ):
        Postures(neither, Bench())


def mute(arm):
    """The arm, with a gripper that does not say how far it opens."""
    return replace(arm, gripper=replace(jaws(arm), unit="percent", apart=None))


@pytest.mark.parametrize("name", sorted({*robots.robot_names()} - {"so101"}))
def test_every_arm_of_every_robot_with_six_joints_goes_straight_down_on_what_is_near_it(name):
    robot = robots.load_robot(name)
    postures, home = Postures(robot, Bench()), robot.poses["home"]
    assert postures.arms == robot.arms
    for arm in robot.arms:
        side = np.sign(postures.tip(arm, home)[0, 3]) if len(robot.arms) > 1 else 0.0
        place = (0.1 * side, 0.28)
        down, over = postures.stations(arm, home, (*place, 0.3), (0.1 * side, 0.38), 0.0, TILTS[0])
        assert over is not None
        tips = np.stack([tip_in_world(robot, arm, q) for q in down])
        np.testing.assert_allclose(tips[:, :2, 3], np.broadcast_to(place, (4, 2)), atol=2e-3)
        assert -tips[-1, 2, 2] == pytest.approx(1.0, abs=1e-3)
        assert abs(math.remainder(math.atan2(tips[-1, 1, 1], tips[-1, 0, 1]) - 0.3, math.pi / 2)) < 0.02
        assert np.abs(np.diff(down, axis=0)).max() < 0.7


def test_an_arm_that_cannot_point_down_is_named():
    with pytest.raises(SetupError, match=r"so101 cannot pick things up: arm cannot hold its fingertips down"):
        Postures(robots.load_robot("so101"), Bench())
