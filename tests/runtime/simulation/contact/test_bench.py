"""Friction alone holds, drops and tips a block; the operator's hands are those of the bench without forces."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robots
from runtime.simulation.bench.bench import BenchError, tip_in_world
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.plant import Plant
from runtime.simulation.bench.tabletop import Tabletop
from runtime.simulation.contact.bench import ContactTabletop
from runtime.simulation.contact.physics import Physics
from runtime.simulation.scripts.pick_place import Skill
from tests.examples import some
from tests.runtime.simulation.bench_trial import Trial
from tests.runtime.simulation.simulated_operator import (
    LEFT,
    OPEN,
    POSITIONS,
    RATE,
    READY,
    RIGHT,
    ROBOT,
    SHUT,
    SimulatedOperator,
)
from tests.runtime.simulation.tabletop_station import pick_and_place
from tests.runtime.simulation.test_any_robot import EVERY_MILESTONE, IN_JOINTS

EDGE = 0.04
MASS, FRICTION, GRAVITY = Physics().block_mass, Physics().finger_friction, 9.81


def operator(**physics):
    """The hands of the other bench's tests, at a bench with forces."""
    make = partial(ContactTabletop, physics=Physics(**{k: v for k, v in physics.items() if k != "arm"}))
    return SimulatedOperator(arm=physics.get("arm", LEFT), make=make)


def pushed(hands, height, way=0.05):
    """How upright the block's own z axis is after closed fingers pushed it slowly, at this height above the table."""
    x, y, _, yaw = hands.block
    ahead, across = np.array([math.cos(yaw), math.sin(yaw)]), yaw + math.pi / 2
    start = np.array([x, y]) - 0.06 * ahead
    hands.jaws_go(SHUT)
    hands.goes(*start, 0.09, across, 0.1)
    hands.goes(*start, height, across)
    for part in np.linspace(0, way, 26)[1:]:
        hands.goes(*(start + part * ahead), height, across, seconds=0.1)
    return float(hands.table.state().blocks[0].pose[2, 2])


@pytest.mark.some(1)
@pytest.mark.parametrize("arm", [LEFT, RIGHT], ids=["left", "right"])
def test_a_block_that_friction_holds_is_lifted_and_placed(arm):
    hands = operator(arm=arm)
    hands.closes_on_block()
    assert hands.truth["held"] == [arm.name]
    assert hands.jaws == pytest.approx(EDGE, abs=1e-3)
    hands.lifts()
    lifted = hands.block[2]
    assert lifted > 0.06
    hands.commands(hands.plant.target, 2.0)
    assert hands.block[2] == pytest.approx(lifted, abs=5e-4)
    hands.places()
    assert hands.truth["held"] == [""]
    assert hands.truth["milestones"] == EVERY_MILESTONE
    hands.commands(hands.plant.target, 0.3)
    assert hands.truth["success"] is True
    assert hands.block[2] == pytest.approx(0.012 + EDGE / 2, abs=1e-4)


def test_jaws_that_are_half_closed_let_the_block_slip():
    hands = operator()
    x, y, _, yaw = hands.block
    hands.goes(x, y, 0.09, yaw, 0.1)
    hands.goes(x, y, 0.02, yaw)
    hands.jaws_go(0.05)
    hands.lifts()
    assert hands.block[2] == pytest.approx(EDGE / 2, abs=1e-3)
    hands.closes_on_block()
    hands.lifts()
    assert hands.block[2] > 0.06
    hands.jaws_go(0.05)
    assert hands.truth["held"] == [""]
    assert hands.block[2] == pytest.approx(EDGE / 2, abs=1e-3)


@pytest.mark.parametrize(("times", "falls"), [(1, False), (5, True)])
def test_a_grip_that_holds_a_block_does_not_hold_one_five_times_as_heavy(times, falls):
    force = 2.5 * MASS * GRAVITY / (2 * FRICTION)  # two fingers carry two and a half blocks
    hands = operator(block_mass=times * MASS, grip_force=force)
    hands.closes_on_block()
    assert hands.truth["held"] == ["left_arm"]
    hands.lifts()
    hands.commands(hands.plant.target, 1.0)
    assert hands.truth["held"] == ["" if falls else "left_arm"]
    assert (hands.block[2] < 0.03) is falls


@pytest.mark.parametrize(("height", "topples"), [(0.034, True), (0.022, False)])
def test_a_block_pushed_above_the_height_that_friction_decides_topples(height, topples):
    """With friction t of the table and f of the finger, it slides if height / edge < (1 - t f) / (2 t) + f."""
    table, finger = 0.9, 0.3
    limit = EDGE * ((1 - table * finger) / (2 * table) + finger)
    assert (height > limit) is topples
    upright = pushed(operator(table_friction=table, finger_friction=finger), height)
    assert (upright < 0.9) is topples


def test_a_block_that_is_pressed_on_stops_the_arm_and_not_the_table():
    hands = operator()
    x, y, _, yaw = hands.block
    hands.jaws_go(SHUT)
    hands.goes(x, y, 0.09, yaw, 0.1)
    hands.goes(x, y, 0.01, yaw, seconds=2.0)
    assert tip_in_world(ROBOT, LEFT, hands.plant.q)[2, 3] > 0.036
    assert hands.block[2] > EDGE / 2 - 2e-3
    assert np.abs(hands.plant.q - hands.plant.target).max() > 0.05
    hands.goes(x, y, 0.09, yaw, 0.1)
    assert hands.block[2] == pytest.approx(EDGE / 2, abs=1e-3)


def test_a_held_block_that_is_lowered_too_far_slips_up_between_the_fingers():
    hands = operator()
    hands.closes_on_block()
    hands.lifts()
    x, y = hands.truth["plate"]
    hands.goes(x, y, 0.08, hands.block[3], 0.1)
    hands.goes(x, y, 0.01, hands.block[3])
    assert hands.block[2] == pytest.approx(0.012 + EDGE / 2, abs=2e-3)
    assert hands.truth["held"] == ["left_arm"]


def test_a_robot_that_stops_keeps_its_grip():
    hands = operator()
    hands.closes_on_block()
    hands.lifts()
    hands.plant.hold()
    hands.commands(hands.plant.target, 2.0)
    assert hands.truth["held"] == ["left_arm"]
    assert hands.block[2] > 0.06


@pytest.mark.some(2)
@pytest.mark.parametrize("name", robots.robot_names())
def test_arms_that_touch_nothing_move_and_come_to_rest_as_on_the_bench_without_forces(name):
    robot = robots.load_robot(name)
    arms = np.delete(np.arange(robot.dim), robot.gripper_dims)
    courses = []
    for make in (Tabletop, ContactTabletop):
        table, plant = make(robot, 0), Plant(robot)
        plant.target = robot.poses["ready"]
        course = []
        for _ in range(90):
            table.advance(plant, 1 / RATE)
            course.append(plant.q)
        courses.append(np.array(course))
    np.testing.assert_allclose(courses[1][:, arms], courses[0][:, arms], atol=5e-3)
    np.testing.assert_allclose(courses[1][-1], robot.poses["ready"], atol=1e-3)
    np.testing.assert_array_equal(courses[1][-1], courses[1][-10])


def test_the_same_seed_and_commands_give_the_same_bits_whatever_was_before():
    courses, hands = [], operator()
    for name in ("first", "second"):
        hands.table.reset(ResetRequest(name, 3, POSITIONS))
        hands.plant.q = hands.plant.target = READY
        hands.closes_on_block(turn=0.2)
        hands.lifts()
        hands.jaws_go(OPEN)
        poses = [block.pose for block in hands.table.state().blocks]
        courses.append((hands.truth | {"reset": ""}, hands.plant.q.tobytes(), np.array(poses).tobytes()))
    assert courses[0] == courses[1]


def test_it_is_laid_out_as_the_bench_without_forces_and_tells_the_same_truth():
    tables = [make(ROBOT, 3, 3) for make in (Tabletop, ContactTabletop)]
    assert tables[0].truth() == tables[1].truth()
    for wish in (ResetRequest("a", 1, POSITIONS), ResetRequest("b", 2)):
        for table in tables:
            table.reset(wish)
        assert tables[0].truth() == tables[1].truth()
    before = tables[1].truth()
    with pytest.raises(BenchError, match="apart"):
        tables[1].reset(ResetRequest("bad", 1, {"block": [0.0, 0.3, 0.0], "plate": [0.0, 0.35]}))
    tables[1].reset(ResetRequest("b", 99))
    assert tables[1].truth() == before


def test_blocks_that_nothing_touches_stay_where_they_are():
    table, plant = ContactTabletop(ROBOT, 3, 3), Plant(ROBOT)
    before = np.array(table.truth()["blocks"])
    for _ in range(3 * RATE):
        table.advance(plant, 1 / RATE)
    np.testing.assert_allclose(table.truth()["blocks"], before, atol=1e-4)
    shown = [block.pose for block in table.state().blocks]
    table.advance(plant, 1 / RATE)
    np.testing.assert_array_equal(
        [block.pose for block in table.state().blocks], shown
    )  # no image is drawn again


def test_the_scripted_policy_puts_the_block_on_the_plate():
    outcome = Trial(Skill(0.001), make=ContactTabletop).lay(1).run()
    assert outcome.success, outcome
    assert outcome.milestones == EVERY_MILESTONE


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["tabletop_ur5e", *IN_JOINTS])
def test_so_it_does_with_every_robot(name, tmp_path):
    trial = pick_and_place(name, 1, tmp_path, make=ContactTabletop)
    assert trial.success, trial.events
    assert trial.milestones == EVERY_MILESTONE


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["tabletop_agilex_piper_eef", "tabletop_ur5e_eef", "tabletop_dual_franka"])
def test_so_it_does_in_poses(name, tmp_path):
    trial = pick_and_place(name, 2, tmp_path, ['policy.action_space="eef"'], make=ContactTabletop)
    assert trial.success, trial.events
    assert trial.milestones == EVERY_MILESTONE


@pytest.mark.exhaustive
@settings(max_examples=some(10))
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_whatever_is_commanded_blocks_are_numbers_and_not_below_the_table(seed, blocks):
    chance = np.random.default_rng(seed)
    hands = SimulatedOperator(seed=seed, blocks=blocks, make=ContactTabletop)
    for _ in range(12):
        target = hands.plant.q + chance.normal(0.0, 0.3, ROBOT.dim)
        hands.commands(np.clip(target, ROBOT.lower, ROBOT.upper), chance.uniform(0.1, 0.6))
        assert np.isfinite(hands.plant.q).all()
        for state in hands.table.state().blocks:
            assert np.isfinite(state.pose).all()
            assert state.pose[2, 3] > 0


def test_numbers_that_run_away_move_neither_robot_nor_blocks(caplog, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hands = operator()
    hands.commands(READY, 1.0)
    joints, blocks = hands.plant.q.copy(), hands.table.truth()["blocks"]
    hands.table._data.qvel[:] = np.nan
    hands.commands(READY, 0.1)
    assert "the physics diverged" in caplog.text
    assert "QVEL" in caplog.text
    assert list(tmp_path.iterdir()) == []  # MuJoCo's own log file
    np.testing.assert_allclose(hands.plant.q, joints, atol=1e-3)
    np.testing.assert_allclose(hands.table.truth()["blocks"], blocks, atol=1e-3)
    hands.closes_on_block()
    assert hands.truth["held"] == ["left_arm"]


@pytest.mark.parametrize("seconds", [0.001, 1 / 30, 0.2])
def test_a_tick_of_any_length_is_one_that_the_bench_can_take(seconds):
    table, plant = ContactTabletop(ROBOT, 0), Plant(ROBOT)
    before = table.truth()["blocks"]
    table.advance(plant, seconds)
    np.testing.assert_allclose(table.truth()["blocks"], before, atol=1e-4)
