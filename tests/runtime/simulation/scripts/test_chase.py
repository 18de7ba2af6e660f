from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import robots
from runtime.core.clock import VirtualClock
from runtime.core.errors import SetupError
from runtime.core.types import Float64
from runtime.simulation.bench.bench import Belt, BenchLayout, tip_in_world
from runtime.simulation.scripts.chase import (
    LEAD,
    SPEED,
    ChaseScript,
    PlaceMap,
)
from runtime.simulation.scripts.pick_place import ScriptError
from tests.runtime.simulation.drawn_bench import drawn

ROBOT = robots.load_robot("agilex_piper")
READY = ROBOT.poses["ready"]
BELT = Belt()
PLACES = PlaceMap(ROBOT, BELT)
RATE, HORIZON = 30.0, 50
ASIDE = (-0.3, 0.15)


class Watcher:
    """A policy that is shown a block at one x [m] after the other."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.policy = ChaseScript(ROBOT, HORIZON, RATE, clock=self.clock, places=PLACES)
        self.answer = self.policy.begin()

    def ask(self, q: Float64, x: float | None, after: float = 0.0) -> Float64:
        """The rows, `after` seconds later, for a block there, or for none."""
        self.clock.advance(after)
        blocks = () if x is None else ((x, BELT.y, 0.0),)
        return self.answer(q, {"cam_high": drawn(BenchLayout(blocks, (ASIDE,)))}, "").astype(np.float64)


def beside(x: float) -> Float64:
    return PLACES.joints(np.array([x]), np.array([BELT.y]))[0]


def ridden(rows: Float64) -> Float64:
    """Where along the belt the fingertips nearest to it are in each row [m]."""
    dx, dy, height = BELT.fingertip_offset
    tips = np.array([[tip_in_world(ROBOT, arm, row)[:3, 3] for arm in ROBOT.arms] for row in rows])
    nearest = np.abs(tips[..., 1:] - (BELT.y + dy, height)).sum(axis=-1).argmin(axis=-1)
    return tips[np.arange(len(rows)), nearest, 0] - dx


def test_the_map_puts_fingertips_beside_the_block() -> None:
    chance = np.random.default_rng(0)
    for x, y in zip(
        chance.uniform(*BELT.x, 40), chance.uniform(BELT.y - 0.03, BELT.y + 0.03, 40), strict=True
    ):
        q = PLACES.joints(np.array([x]), np.array([y]))[0]
        away = [
            np.linalg.norm(tip_in_world(ROBOT, arm, q)[:3, 3] - (x, y, 0) - BELT.fingertip_offset)
            for arm in ROBOT.arms
        ]
        assert min(away) < 1e-3


def test_places_beyond_the_map_are_those_at_its_edge() -> None:
    inside = PLACES.joints(np.array([BELT.x[1] + 0.02]), np.array([BELT.y]))
    np.testing.assert_allclose(PLACES.joints(np.array([5.0]), np.array([BELT.y])), inside)


def test_a_block_that_was_seen_once_is_taken_to_stand() -> None:
    rows = Watcher().ask(beside(0.1), 0.1)
    assert rows.shape == (HORIZON, ROBOT.dim)
    np.testing.assert_allclose(ridden(rows), 0.1, atol=2e-3)


@pytest.mark.parametrize("interval", [0.1, 0.5])
def test_a_block_that_moves_is_taken_to_go_on_and_led_by_what_robots_lag(interval: float) -> None:
    watcher, speed = Watcher(), 0.08
    for number in range(3):
        x = speed * interval * number
        rows = watcher.ask(beside(x), x, interval if number else 0.0)
    ahead = np.arange(HORIZON) / RATE + LEAD
    seen_as_well_as_pictures_show_it = 0.003 + 0.005 * ahead  # m, and m/s
    assert (np.abs(ridden(rows) - x - speed * ahead) <= seen_as_well_as_pictures_show_it).all()


def test_it_is_not_taken_to_leave_the_belt() -> None:
    watcher = Watcher()
    watcher.ask(beside(0.2), 0.2)
    rows = watcher.ask(beside(0.24), 0.24, 0.4)
    assert ridden(rows).max() <= BELT.x[1] + 2e-3
    assert ridden(rows)[-1] == pytest.approx(BELT.x[1], abs=2e-3)


def test_what_was_seen_long_ago_says_nothing_about_velocity() -> None:
    watcher = Watcher()
    watcher.ask(beside(0.0), 0.0)
    rows = watcher.ask(beside(0.2), 0.2, 10.0)
    np.testing.assert_allclose(ridden(rows), 0.2, atol=2e-3)


def test_it_goes_there_no_faster_than_it_is_used_to() -> None:
    rows = Watcher().ask(READY, 0.1)
    assert np.abs(rows[0] - READY).max() <= SPEED * LEAD + 1e-6
    assert np.abs(np.diff(rows, axis=0)).max() <= SPEED / RATE + 1e-6
    assert ridden(rows[-1:])[0] == pytest.approx(0.1, abs=2e-3)


def test_a_block_out_of_sight_goes_on_as_it_did() -> None:
    watcher = Watcher()
    for x in (0.0, 0.02):
        watcher.ask(beside(x), x, 0.25)
    rows = watcher.ask(beside(0.04), None, 0.25)
    assert ridden(rows)[0] == pytest.approx(0.04 + 0.08 * LEAD, abs=4e-3)


def test_before_it_has_seen_the_block_it_stays_where_it_is() -> None:
    rows = Watcher().ask(READY, None)
    assert (rows == READY.astype(np.float32)).all()


def test_every_connection_begins_with_nothing_seen() -> None:
    watcher = Watcher()
    watcher.ask(beside(0.1), 0.1)
    watcher.answer = watcher.policy.begin()
    assert (watcher.ask(READY, None) == READY.astype(np.float32)).all()


def test_a_request_without_its_picture_is_an_error() -> None:
    with pytest.raises(ScriptError, match="no picture 'cam_high'; it has none"):
        Watcher().answer(READY, {}, "")


def test_a_belt_out_of_reach_is_refused() -> None:
    with pytest.raises(
        SetupError, match=r"no arm of agilex_piper reaches all of the belt from x -0.1 to 0.3 m, y 0.9 m"
    ):
        PlaceMap(ROBOT, replace(BELT, y=0.9))
