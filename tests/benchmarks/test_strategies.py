from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.reference import Reference, chunks_of, make_policy
from benchmarks.strategies import CHECKED, KINDS, Cell, _row, measure_reaction, measure_tracking
from benchmarks.strategy_station import compare
from runtime.core.plugins import variants
from runtime.core.types import Conditioning
from runtime.strategies import overlap
from runtime.strategies.base import StrategyParameters


@dataclass(frozen=True, slots=True)
class Late(Cell):
    """`async` that may drop too few stale rows, as a bound on them makes it do."""

    @property
    def config(self) -> StrategyParameters:
        return overlap.Config(k_max=3)


def the_cell(kind: str, **other: object) -> Cell:
    values = {"control_hz": 30.0, "inference_hz": 3.0, "horizon": 50, "delay": 3} | other
    return Cell(kind, **values)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", KINDS)
def test_no_strategy_is_late_where_the_horizon_covers_delay_and_interval(kind: str) -> None:
    tracked = measure_tracking(the_cell(kind), disagree=False)
    assert tracked.offset == 0.0
    assert tracked.starved == tracked.unrecovered == 0


def test_lateness_is_found_in_the_numbers_alone() -> None:
    assert measure_tracking(Late("async", 30.0, 3.0, 50, 5), disagree=False).offset == pytest.approx(
        2.0, abs=1e-3
    )


def test_only_what_follows_the_clock_follows_the_reference() -> None:
    assert measure_tracking(the_cell("async"), disagree=False).rms_error == 0.0
    assert measure_tracking(the_cell("sync"), disagree=False).rms_error > 0.05


def test_blending_costs_reaction_and_saves_jerk() -> None:
    reaction = {kind: measure_reaction(the_cell(kind))[2] for kind in KINDS}
    assert reaction["naive"] < reaction["async"] <= 3 + 8 + 10 < reaction["ensemble"] < reaction["sync"]
    jerk = {kind: measure_tracking(the_cell(kind), disagree=True).jerk_ratio for kind in KINDS}
    assert jerk["async"] < jerk["naive"]


def test_a_cell_whose_chunks_are_too_short_starves_and_comes_back_and_has_no_reaction() -> None:
    row = _row(the_cell("async", horizon=16, inference_hz=1.0))
    assert not row["feasible"]
    assert row["starved_steps"] > 30
    assert row["recovered"]
    assert row["reaction99_steps"] is None


def test_every_strategy_has_a_cell_that_is_checked_in_lockstep() -> None:
    assert {case.strategy for case in CHECKED} == set(KINDS) == set(variants("runtime.strategies"))


@pytest.mark.some(1)
@pytest.mark.parametrize("case", [c for c in CHECKED if c.delay == 15 and c.inference_hz], ids=str)
def test_the_whole_station_plans_what_the_step_loop_plans_to_the_bit(case: Cell) -> None:
    assert compare(case)[1] == 0
    assert compare(case)[0] > 200


def test_the_stand_in_keeps_to_what_the_robot_is_committed_to_and_then_means_its_own() -> None:
    table = Reference(30.0).at(np.arange(100.0))
    previous = np.zeros((50, 3), np.float32)
    rows = make_policy(chunks_of(table, 50))(10, Conditioning(previous, 10, 4, 50))
    assert (rows[:5] == 0).all()
    np.testing.assert_allclose(rows[11:], table[21:60])
