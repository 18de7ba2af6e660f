from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import robots
from runtime.simulation.bench.belt_motion import draw_belt_motion
from runtime.simulation.bench.bench import BenchError
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.conveyor import (
    CONVEYOR,
    COURSE_S,
    REQUIRED,
    TOLERANCE_M,
    Conveyor,
    TrackingErrors,
)
from runtime.simulation.bench.plant import Plant
from runtime.simulation.scripts.chase import PlaceMap

ROBOT = robots.load_robot("agilex_piper")
READY = ROBOT.poses["ready"]
BELT = CONVEYOR.belt
assert BELT is not None
PLACES = PlaceMap(ROBOT, BELT)
TICK = 1 / 30


class Bench:
    """A conveyor, and a plant that is put wherever the test wants it."""

    def __init__(self, seed: int = 0) -> None:
        self.conveyor = Conveyor(ROBOT, seed)
        self.plant = Plant(ROBOT, start=READY)

    @property
    def x(self) -> float:
        return float(self.conveyor.state().blocks[0].pose[0, 3])

    def put(self, x: float) -> None:
        """Fingertips beside a block at x, if it were there."""
        self.plant.q = PLACES.joints(np.array([x]), np.array([BELT.y]))[0]
        self.plant.hold()

    def tick(self, follow: float | None = None) -> dict[str, Any]:
        """A tick, with the fingertips so far [m] along the belt from their place; None where they are ready."""
        if follow is not None:
            self.put(self.x + follow)
        self.conveyor.advance(self.plant, TICK)
        return self.conveyor.truth()

    def run(self, follow: float = 0.0) -> dict[str, Any]:
        """The whole course."""
        truth = self.tick(follow)
        while not self.conveyor.over:
            truth = self.tick(follow)
        return truth


def test_the_belt_stands_until_fingertips_are_beside_the_block() -> None:
    bench = Bench()
    before = bench.x
    for _ in range(30):
        truth = bench.tick()
    assert bench.x == before == draw_belt_motion(0, BELT, COURSE_S).x(0.0)
    assert truth["milestones"] == {"reached": False, "followed": False}
    assert truth["chase"]["seconds"] == 0.0
    bench.tick(0.0)
    truth = bench.tick()
    assert truth["milestones"]["reached"]
    assert bench.x != before


def test_the_block_rides_the_course_of_its_seed_whatever_the_steps_of_time() -> None:
    course = draw_belt_motion(4, BELT, COURSE_S)
    for seconds in (TICK, 0.1):
        bench = Bench(4)
        bench.tick(0.0)
        for _ in range(60):
            bench.conveyor.advance(bench.plant, seconds)
            told = bench.conveyor.truth()["chase"]
            assert isinstance(told, dict)
            assert bench.x == pytest.approx(course.x(told["seconds"]), abs=1e-9)
        assert told["seconds"] == pytest.approx(60 * seconds, abs=0.02)


def test_the_same_seed_is_the_same_to_the_last_bit() -> None:
    one, two, other = Bench(1), Bench(1), Bench(2)
    courses = [[bench.tick(0.0)["blocks"] for _ in range(90)] for bench in (one, two, other)]
    assert courses[0] == courses[1] != courses[2]
    assert one.conveyor.truth() == two.conveyor.truth()


def test_who_stays_beside_it_succeeds_and_only_at_the_end() -> None:
    bench = Bench()
    truths = [bench.tick(0.0) for _ in range(300)]
    assert not any(truth["success"] for truth in truths)
    truth = bench.run()
    assert truth["success"]
    assert truth["milestones"] == {"reached": True, "followed": True}
    told = truth["chase"]
    assert told["share"] == 1.0
    assert told["p95"] < 1e3 * TOLERANCE_M
    assert told["seconds"] == pytest.approx(COURSE_S, abs=0.2)
    assert bench.tick()["chase"] == pytest.approx({**told, "distance": 1e3 * bench.conveyor.distance()})


def test_who_is_too_far_from_it_fails_and_the_distance_is_told() -> None:
    bench = Bench()
    bench.tick(0.0)
    for _ in range(3):
        bench.tick()
    truth = bench.run(follow=1.5 * TOLERANCE_M)
    assert not truth["success"]
    assert truth["chase"]["share"] < 0.02
    assert truth["chase"]["mean"] == pytest.approx(1.5e3 * TOLERANCE_M, abs=4.0)
    assert truth["chase"]["distance"] == pytest.approx(1.5e3 * TOLERANCE_M, abs=4.0)


@pytest.mark.exhaustive
def test_two_thirds_of_the_time_are_enough_and_less_is_not() -> None:
    for part, enough in ((REQUIRED + 0.05, True), (REQUIRED - 0.05, False)):
        bench = Bench()
        bench.tick(0.0)
        while not bench.conveyor.over:
            away = 0.0 if bench.conveyor.truth()["chase"]["seconds"] < part * COURSE_S else 0.05
            truth = bench.tick(away)
        assert truth["success"] is enough
        assert truth["chase"]["share"] == pytest.approx(part, abs=0.03)


def test_a_block_beside_the_belt_rides_no_more() -> None:
    bench = Bench()
    bench.tick(0.0)
    bench.conveyor._blocks[0].shift(np.array([0.0, 0.06]))
    before = bench.x
    for _ in range(30):
        bench.tick()
    assert bench.x == before


def test_a_reset_lays_another_course_once() -> None:
    bench = Bench()
    for _ in range(60):
        bench.tick(0.0)
    bench.conveyor.reset(ResetRequest("again", 7))
    assert bench.x == draw_belt_motion(7, BELT, COURSE_S).x(0.0)
    truth = bench.tick()
    assert (truth["reset"], truth["seed"]) == ("again", 7)
    assert truth["milestones"] == {"reached": False, "followed": False}
    assert truth["chase"]["seconds"] == truth["chase"]["mean"] == 0.0
    for _ in range(30):
        bench.tick(0.0)
    before = bench.x
    bench.conveyor.reset(ResetRequest("again", 7))
    assert bench.x == before


def test_positions_are_refused_and_nothing_has_changed() -> None:
    bench = Bench()
    for _ in range(60):
        bench.tick(0.0)
    before = bench.conveyor.truth()
    with pytest.raises(BenchError, match="positions name block; allowed on a conveyor: none"):
        bench.conveyor.reset(ResetRequest("elsewhere", 7, {"block": [0.0, 0.3, 0.0]}))
    assert bench.conveyor.truth() == before


def test_before_anything_has_moved_there_is_no_distance() -> None:
    conveyor = Conveyor(ROBOT, 0)
    assert conveyor.distance() == math.inf
    assert conveyor.truth()["chase"]["distance"] is None


def test_an_escort_knows_shares_means_and_quantiles() -> None:
    escort = TrackingErrors()
    assert (escort.on_target_share, escort.mean, escort.quantile(0.95)) == (0.0, 0.0, 0.0)
    millimetres = [*range(1, 101)]
    for number in np.random.default_rng(0).permutation(millimetres).tolist():
        escort.add(number / 1000)
    assert escort.on_target_share == 0.2
    assert escort.mean == pytest.approx(0.0505)
    assert [escort.quantile(part) for part in (0.01, 0.5, 0.95, 1.0)] == [0.001, 0.05, 0.095, 0.1]
    assert all(one <= other for one, other in pairwise(escort.distances))
