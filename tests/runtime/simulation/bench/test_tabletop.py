from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.simulation.bench.bench import BenchError
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.tabletop import Tabletop
from tests.examples import some
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

EDGE = 0.04


@pytest.mark.some(1)
@pytest.mark.parametrize("arm", [LEFT, RIGHT], ids=["left", "right"])
@pytest.mark.parametrize("turn", [0.0, 0.3, -0.4])
@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_a_block_picked_from_above_and_put_on_the_plate_is_a_success(arm, turn, tilt):
    hands = SimulatedOperator(arm=arm)
    assert hands.truth["milestones"] == {
        "grasped": False,
        "lifted": False,
        "over_plate": False,
        "placed": False,
    }
    hands.closes_on_block(turn=turn, tilt=tilt)
    assert hands.truth["held"] == [arm.name]
    assert hands.jaws == pytest.approx(EDGE)
    hands.lifts()
    assert hands.block[2] > 0.06
    assert not hands.truth["success"]
    hands.places()
    assert hands.truth["held"] == [""]
    assert all(hands.truth["milestones"].values())
    assert hands.truth["success"] is True
    assert hands.block[2] == pytest.approx(0.012 + EDGE / 2, abs=1e-6)
    flat = hands.table.state().blocks[0].pose[:3, :3]
    assert np.abs(flat[2]).max() == pytest.approx(1.0)


def test_jaws_that_close_on_a_block_turn_it_straight_and_move_it_between_them():
    hands = SimulatedOperator()
    x, y, _, yaw = hands.block
    hands.goes(x + 0.012, y, 0.09, yaw + 0.4, 0.1)
    hands.goes(x + 0.012, y, 0.02, yaw + 0.4)
    assert hands.block == pytest.approx((x, y, EDGE / 2, yaw))
    hands.jaws_go(SHUT)
    turned = (hands.block[3] - yaw - 0.4) % (math.pi / 2)
    assert min(turned, math.pi / 2 - turned) < 0.02
    assert hands.block[2] == pytest.approx(EDGE / 2, abs=1e-6)
    assert 0.002 < math.dist(hands.block[:2], (x, y)) < 0.02


@pytest.mark.some(2)
@pytest.mark.parametrize(
    ("how", "stops_at"),
    [
        ({"aside": 0.05}, SHUT),
        ({"height": 0.05}, SHUT),
        ({"aside": 0.022}, EDGE),
        ({"turn": 0.7}, EDGE * (math.cos(0.7) + math.sin(0.7))),
        ({"tilt": 0.6}, EDGE),
    ],
    ids=["beside it", "over it", "at its end", "on its corners", "leaning too far"],
)
def test_jaws_that_do_not_close_around_a_block_from_above_do_not_lift_it(how, stops_at):
    hands = SimulatedOperator()
    hands.closes_on_block(**how)
    assert hands.jaws == pytest.approx(stops_at, abs=1e-3)
    assert hands.truth["held"] == [""]
    hands.lifts()
    assert hands.block[2] == pytest.approx(EDGE / 2, abs=1e-6)
    assert not any(hands.truth["milestones"].values())


def test_opening_in_mid_air_drops_the_block_which_comes_to_lie_on_a_face():
    hands = SimulatedOperator()
    hands.closes_on_block()
    x, y, _, yaw = hands.block
    hands.goes(x, y + 0.05, 0.15, yaw, tilt=0.5)
    held = hands.table.state().blocks[0].pose
    assert np.abs(held[2, :3]).max() < 0.95
    hands.jaws_go(OPEN, seconds=4 / RATE)
    assert EDGE < hands.block[2] < held[2, 3]
    assert hands.truth["held"] == [""]
    hands.jaws_go(OPEN, seconds=1.0)
    assert hands.block[2] == pytest.approx(EDGE / 2, abs=1e-6)
    assert np.abs(hands.table.state().blocks[0].pose[2, :3]).max() == pytest.approx(1.0)
    assert hands.truth["milestones"] == {
        "grasped": True,
        "lifted": True,
        "over_plate": False,
        "placed": False,
    }
    assert hands.truth["success"] is False


def test_a_block_that_is_taken_off_the_plate_again_is_no_longer_placed():
    hands = SimulatedOperator()
    hands.closes_on_block()
    hands.lifts()
    hands.places()
    assert hands.truth["success"]
    hands.closes_on_block(height=0.036)
    assert hands.truth["success"] is False
    assert hands.truth["milestones"]["placed"] is False
    assert hands.truth["milestones"]["over_plate"] is True


def test_a_block_on_the_rim_is_placed_and_no_success():
    hands = SimulatedOperator()
    hands.closes_on_block()
    hands.lifts()
    x, y = hands.truth["plate"]
    yaw = hands.block[3]
    hands.goes(x + 0.07, y, 0.08, yaw, 0.1)
    hands.goes(x + 0.07, y, 0.036, yaw)
    hands.jaws_go(OPEN)
    assert hands.truth["milestones"]["placed"] is True
    assert hands.truth["success"] is False


def test_a_held_block_does_not_go_through_the_table_or_the_plate():
    hands = SimulatedOperator()
    hands.closes_on_block()
    hands.lifts()
    x, y = hands.truth["plate"]
    yaw = hands.block[3]
    hands.goes(x, y, 0.08, yaw, 0.1)
    hands.goes(x, y, 0.01, yaw)
    assert hands.block[2] == pytest.approx(0.012 + EDGE / 2, abs=1e-6)
    assert hands.truth["held"] == ["left_arm"]
    hands.lifts()
    assert hands.block[2] > 0.085


def test_closed_fingers_push_a_block_along():
    hands = SimulatedOperator()
    x, y, _, yaw = hands.block
    hands.jaws_go(SHUT)
    hands.goes(x - 0.06, y, 0.09, 0.0, 0.1)
    hands.goes(x - 0.06, y, 0.02, 0.0)
    assert hands.block == pytest.approx((x, y, EDGE / 2, yaw))
    hands.goes(x + 0.02, y, 0.02, 0.0)
    assert hands.block[0] > x + 0.04
    assert hands.block[2] == pytest.approx(EDGE / 2, abs=1e-6)


def test_a_block_pushed_against_the_plate_stays_beside_it():
    hands = SimulatedOperator()
    x, y, _, _ = hands.block
    hands.jaws_go(SHUT)
    hands.goes(x, y - 0.06, 0.08, 0.0)
    hands.goes(x, y - 0.06, 0.02, 0.0)
    hands.goes(x - 0.02, y + 0.08, 0.02, 0.0)
    hands.commands(READY, 1.0)
    place = np.array(hands.block[:2]) - hands.truth["plate"]
    assert np.linalg.norm(place) >= 0.075 + 0.9 * EDGE / 2
    assert hands.block[2] == pytest.approx(EDGE / 2, abs=1e-6)


def test_a_block_put_on_another_one_stands_on_it():
    hands = SimulatedOperator(blocks=2)
    low = hands.table._blocks[1]
    low.pose[:2, 3] = -0.26, 0.25
    hands.closes_on_block()
    hands.lifts()
    hands.goes(-0.26, 0.25, 0.075, hands.block[3], 0.1)
    hands.goes(-0.26, 0.25, 0.065, hands.block[3])
    hands.jaws_go(OPEN)
    hands.lifts()
    assert hands.block[2] == pytest.approx(1.5 * EDGE, abs=1e-6)
    assert hands.truth["blocks"][1][:2] == pytest.approx([-0.26, 0.25], abs=0.01)


def test_the_same_commands_from_the_same_reset_give_the_same_course():
    courses = []
    for _ in range(2):
        hands = SimulatedOperator(seed=3)
        hands.closes_on_block(turn=0.2)
        hands.lifts()
        hands.jaws_go(OPEN)
        courses.append((hands.truth, hands.plant.q))
    assert courses[0][0] == courses[1][0]
    np.testing.assert_array_equal(courses[0][1], courses[1][1])


def test_a_reset_lays_the_bench_by_its_seed_and_forgets_what_was_reached():
    hands = SimulatedOperator(seed=1)
    first = hands.truth
    hands.closes_on_block()
    hands.table.reset(ResetRequest("again", 1, POSITIONS))
    assert hands.truth == first | {"reset": "again"}
    hands.table.reset(ResetRequest("another", 2, POSITIONS))
    assert hands.truth["blocks"] != first["blocks"]
    assert hands.truth["seed"] == 2
    np.testing.assert_allclose(hands.truth["blocks"][0][:2], POSITIONS["block"][:2], atol=0.00501)


def test_a_repeated_reset_changes_nothing():
    hands = SimulatedOperator(seed=1)
    hands.closes_on_block()
    before = hands.truth
    hands.table.reset(ResetRequest("reset 1", 99))
    assert hands.truth == before


def test_a_reset_that_cannot_be_leaves_everything_as_it_is():
    hands = SimulatedOperator(seed=1)
    before = hands.truth
    with pytest.raises(BenchError, match="apart"):
        hands.table.reset(ResetRequest("bad", 1, {"block": [0.0, 0.3, 0.0], "plate": [0.0, 0.35]}))
    assert hands.truth == before


@pytest.mark.exhaustive
@settings(max_examples=some(25))
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_whatever_is_commanded_blocks_stay_above_the_table_and_are_numbers(seed, blocks):
    chance = np.random.default_rng(seed)
    hands = SimulatedOperator(seed=seed, blocks=blocks)
    for _ in range(12):
        block = hands.block
        if chance.random() < 0.5:
            target = chance.uniform(ROBOT.lower, ROBOT.upper)
        else:
            target = hands.plant.q + chance.normal(0.0, 0.3, ROBOT.dim)
            target = np.clip(target, ROBOT.lower, ROBOT.upper)
        hands.commands(target, chance.uniform(0.1, 0.6))
        assert block is not None
        for held, state in zip(hands.truth["held"], hands.table.state().blocks, strict=True):
            assert np.isfinite(state.pose).all()
            assert held in {"", "left_arm", "right_arm"}
            lowest = state.pose[2, 3] - EDGE / 2 * np.abs(state.pose[2, :3]).sum()
            assert lowest >= -1e-9
            np.testing.assert_allclose(state.pose[:3, :3] @ state.pose[:3, :3].T, np.eye(3), atol=1e-6)
        assert np.isfinite(hands.plant.q).all()


@pytest.mark.parametrize("seconds", [0.001, 1 / 30, 0.2])
def test_a_tick_of_any_length_is_one_that_the_bench_can_take(seconds):
    table = Tabletop(ROBOT, 0)
    before = table.truth()
    hands = SimulatedOperator()
    table.advance(hands.plant, seconds)
    assert table.truth()["blocks"] == before["blocks"]
