from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import robots
from robots.clearance import Clearance
from runtime.simulation.bench import bench
from runtime.simulation.bench.bench import Bench
from runtime.simulation.bench.layout import draw_layout
from runtime.simulation.scripts.postures import CLEAR, gripper_dim
from runtime.simulation.scripts.routes import PlannedFailure, RoutePlanner

ROBOT = robots.load_robot("agilex_piper")
LEFT, RIGHT = ROBOT.arms
READY, HOME = ROBOT.poses["ready"], ROBOT.poses["home"]
RATE = 30.0
PLANNER = RoutePlanner(ROBOT, RATE, Bench())
BLOCK, PLATE = (-0.1, 0.26, 0.4), (-0.05, 0.38)
ANGLES = np.setdiff1d(np.arange(ROBOT.dim), ROBOT.gripper_dims)
SURE = PlannedFailure()


def planned(q=READY, block=BLOCK, plate=PLATE, slip=SURE):
    route = PLANNER.pick_and_place(q, block, plate, slip)
    assert route is not None
    return route


def leg(route, name):
    return next(leg for leg in route.legs if leg.name == name)


def tips(route, rows):
    return np.stack([bench.tip_in_world(ROBOT, route.arm, row) for row in rows])


def test_the_legs_follow_each_other_without_a_jump_of_the_arm():
    route = planned()
    assert [leg.name for leg in route.legs] == [
        "reach", "descend", "close", "lift", "carry", "lower", "open", "leave", "retreat"
    ]  # fmt: skip
    np.testing.assert_allclose(route.rows[0], READY)
    for before, after in itertools.pairwise(route.legs):
        np.testing.assert_allclose(before.end[ANGLES], after.rows[0][ANGLES], atol=1e-9)
    assert len(route.rows) == sum(len(leg.rows) for leg in route.legs)
    for start, part in zip(route.starts, route.legs, strict=True):
        np.testing.assert_array_equal(route.rows[start], part.rows[0])


@pytest.mark.some(13)
@pytest.mark.parametrize("q", [READY, HOME], ids=["ready", "home"])
@pytest.mark.parametrize("seed", range(20))
def test_every_layout_is_reached_slowly_and_above_the_table(seed, q):
    layout = draw_layout(seed)
    route = planned(q, layout.blocks[0], layout.discs[0])
    speeds = np.abs(np.diff(route.rows, axis=0)) * RATE
    assert speeds[:, ANGLES].max() < 1.2
    accelerations = np.abs(np.diff(route.rows, n=2, axis=0)) * RATE**2
    assert accelerations[:, ANGLES].max() < 15.0
    assert (route.rows >= ROBOT.lower).all()
    assert (route.rows <= ROBOT.upper).all()
    assert tips(route, route.rows)[:, 2, 3].min() > 0.012
    assert 9.0 < len(route.rows) / RATE < 24.0


def test_the_arm_on_the_other_side_stays():
    for block, arm, other in ((BLOCK, LEFT, RIGHT), ((0.1, 0.26, 0.0), RIGHT, LEFT)):
        route = planned(block=block, plate=(0.0, 0.38))
        assert route.arm.name == arm.name
        still = route.rows[:, other.slice]
        np.testing.assert_allclose(still, np.broadcast_to(READY[other.slice], still.shape))


@pytest.mark.parametrize("yaw", [-0.7, -0.3, 0.0, 0.5])
def test_it_comes_straight_down_on_the_block_with_the_jaws_along_its_sides(yaw):
    route = planned(block=(-0.1, 0.26, yaw))
    way = tips(route, leg(route, "descend").rows)
    np.testing.assert_allclose(way[:, :2, 3], np.broadcast_to([-0.1, 0.26], (len(way), 2)), atol=0.004)
    assert way[0, 2, 3] == pytest.approx(CLEAR, abs=0.002)
    assert way[-1, 2, 3] == pytest.approx(0.018, abs=0.002)
    across = way[-1, :2, 1]
    assert abs(math.remainder(math.atan2(across[1], across[0]) - yaw, math.pi / 2)) < math.radians(3)
    assert -way[:, 2, 2].max() > math.cos(math.radians(25))


def test_it_lets_go_just_above_the_middle_of_the_plate():
    route = planned()
    tip = bench.tip_in_world(ROBOT, LEFT, leg(route, "lower").end)
    np.testing.assert_allclose(tip[:2, 3], PLATE, atol=0.002)
    assert tip[2, 3] == pytest.approx(0.012 + 0.018 + 0.003, abs=0.002)


def test_the_jaws_are_closed_while_it_carries_and_open_before_and_after():
    route = planned(HOME)
    jaw = gripper_dim(route.arm)
    for name in ("lift", "carry", "lower"):
        assert leg(route, name).rows[:, jaw].max() < 0.01
    for name in ("descend", "leave", "retreat"):
        assert leg(route, name).rows[:, jaw].min() > 0.09
    assert (leg(route, "close").gate, leg(route, "open").gate) == ("close", "open")


def test_it_ends_at_rest_out_of_the_way():
    route = planned(HOME)
    arm = route.arm.joint_dims
    np.testing.assert_allclose(route.legs[-1].end[arm], READY[arm])


def test_what_neither_arm_reaches_has_no_route():
    assert PLANNER.pick_and_place(READY, (0.0, 0.75, 0.0), PLATE, SURE) is None
    assert PLANNER.pick_and_place(READY, BLOCK, (0.0, 0.75), SURE) is None


def test_the_other_arm_takes_what_the_nearer_one_cannot_bring_home():
    route = planned(block=(-0.02, 0.3, 0.0), plate=(0.3, 0.36))
    assert route.arm.name == RIGHT.name


@pytest.mark.some(1)
@pytest.mark.parametrize(
    "name", [name for name in robots.robot_names() if len(robots.load_robot(name).arms) > 1]
)
def test_arms_leave_each_other_room_wherever_block_and_plate_are(name):
    robot = robots.load_robot(name)
    planner, clearance = RoutePlanner(robot, RATE, Bench()), Clearance(robot)
    arms = [f"{arm.name}/" for arm in robot.arms]
    between = [all(any(part.startswith(arm) for part in pair) for arm in arms) for pair in clearance.pairs]
    for pose, seed in itertools.product(("ready", "home"), (0, 4, 6, 14)):
        layout = draw_layout(seed)
        route = planner.pick_and_place(robot.poses[pose], layout.blocks[0], layout.discs[0], SURE)
        assert clearance.distances(route.rows[::5])[:, between].min() > 0.025, (pose, seed)


def test_an_arm_that_would_run_into_the_other_leaves_it_to_that_one():
    layout = draw_layout(4)  # the left arm is nearer to the block, but the plate is far over on the right
    route = planned(block=layout.blocks[0], plate=layout.discs[0])
    assert route.arm is RIGHT
    assert route.legs[0].name == "reach"


def test_an_arm_that_is_in_the_way_of_the_only_one_that_can_makes_way_first():
    robot = robots.load_robot("arx_r5")
    layout = draw_layout(0)
    home, ready = robot.poses["home"], robot.poses["ready"]
    route = RoutePlanner(robot, RATE, Bench()).pick_and_place(home, layout.blocks[0], layout.discs[0], SURE)
    left, right = robot.arms
    assert route.arm is left
    first = route.legs[0]
    assert (first.name, first.others) == ("make way", (right,))
    np.testing.assert_array_equal(np.ptp(first.rows[:, left.slice], axis=0), 0.0)
    np.testing.assert_allclose(first.end[right.joint_dims], ready[right.joint_dims])
    rest = np.concatenate([leg.rows for leg in route.legs[1:]])
    assert np.ptp(rest[:, right.joint_dims], axis=0).max() < 1e-9
    assert rest[0, gripper_dim(right)] == home[gripper_dim(right)]


def test_what_makes_way_rises_from_the_table_first():
    low = leg(
        planned(block=(0.0, 0.3, 0.0), plate=(-0.1, 0.38)), "descend"
    ).end  # the left arm, in the middle
    route = planned(q=low, block=(-0.06, 0.24, 0.0), plate=(0.21, 0.36))  # only the right arm reaches both
    assert route.arm is RIGHT
    assert [leg.name for leg in route.legs[:3]] == ["rise", "make way", "reach"]
    assert route.legs[0].others == route.legs[1].others == (LEFT,)
    assert bench.tip_in_world(ROBOT, LEFT, route.legs[0].end)[2, 3] == pytest.approx(CLEAR, abs=0.003)


def test_a_grasp_can_be_short_of_the_block():
    tip = bench.tip_in_world(ROBOT, LEFT, leg(planned(slip=PlannedFailure(short=0.05)), "descend").end)
    assert math.dist(tip[:2, 3], BLOCK[:2]) == pytest.approx(0.05, abs=0.002)
    assert math.dist(tip[:2, 3], LEFT.mount[:2]) < math.dist(BLOCK[:2], LEFT.mount[:2])


def test_the_block_can_be_let_go_of_on_the_way():
    route = planned(slip=PlannedFailure(lets_go=True))
    assert [leg.name for leg in route.legs[-3:]] == ["carry", "open", "retreat"]
    assert math.dist(bench.tip_in_world(ROBOT, LEFT, leg(route, "carry").end)[:2, 3], PLATE) > 0.03


def test_a_retreat_from_the_table_rises_first():
    low = leg(planned(), "descend").end
    route = PLANNER.retreat(low, LEFT)
    assert [leg.name for leg in route.legs] == ["back off", "retreat"]
    heights = tips(route, leg(route, "back off").rows)[:, 2, 3]
    assert (np.diff(heights) > -1e-4).all()
    assert heights[-1] == pytest.approx(CLEAR, abs=0.003)


def test_a_route_from_the_table_rises_first():
    low = leg(planned(), "descend").end
    route = planned(q=low)
    assert route.legs[0].name == "rise"
    assert bench.tip_in_world(ROBOT, LEFT, route.legs[0].end)[2, 3] == pytest.approx(CLEAR, abs=0.003)


@pytest.mark.some(1)
@pytest.mark.parametrize("name", [name for name in robots.robot_names() if name not in (ROBOT.name, "so101")])
def test_every_robot_reaches_every_layout_slowly_and_above_the_table(name):
    robot = robots.load_robot(name)
    planner, ready = RoutePlanner(robot, RATE, Bench()), robot.poses["ready"]
    moving = np.setdiff1d(np.arange(robot.dim), robot.gripper_dims)
    for seed in range(25):
        layout = draw_layout(seed)
        route = planner.pick_and_place(ready, layout.blocks[0], layout.discs[0], SURE)
        assert route is not None, seed
        assert (np.abs(np.diff(route.rows, axis=0))[:, moving].max() * RATE) < 1.5
        assert (route.rows >= robot.lower).all()
        assert (route.rows <= robot.upper).all()
        heights = [bench.tip_in_world(robot, route.arm, row)[2, 3] for row in route.rows[::4]]
        assert min(heights) > 0.012
        others = np.setdiff1d(np.arange(robot.dim), np.arange(route.arm.slice.start, route.arm.slice.stop))
        assert np.ptp(route.rows[:, others], axis=0).max(initial=0.0) == 0.0
