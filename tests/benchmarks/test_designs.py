"""The benchmark of designs: that its ways to an error and a power are the designs' own, in seconds."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from benchmarks import coverage, designs
from benchmarks.designs import DESIGNS, DRIFTING, boundary_of, errors_at, worst_drift
from evaweb.statistics.designs import design, evaluate_design, in_blocks
from evaweb.statistics.difference import barnard
from evaweb.statistics.planning import exact_power


@pytest.mark.exhaustive
def test_every_figure_has_its_name_and_the_designs_keep_what_they_claim(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(designs, "DIFFERENT", (((0.5, 0.8), 50),))
    monkeypatch.setattr(designs, "SIZES", (50,))
    monkeypatch.setattr(designs, "_RUNS", 40)
    monkeypatch.setattr(designs, "_of_scipy", lambda rates, n: 0.0)
    monkeypatch.setattr(coverage, "CASES", {"always": coverage.Case(lambda *_: True)})
    found = {figure.name: figure for figure in designs.measure(0.0).figures}
    for name in DESIGNS:
        assert f"type1.{name}.50" in found
        assert any(other.startswith(f"median_pairs.{name}.") for other in found)
    assert found["power.early.0.5.0.8.50"].holds
    assert found["coverage.always.1"].holds
    assert not [name for name, figure in found.items() if figure.holds is False]
    assert found["drift.early_margin_at_0.1.30"].value > 0.105 > found["type1.early_margin_at_0.1.30"].value


def test_a_fixed_number_is_the_boundary_of_barnards_test() -> None:
    exact = boundary_of(DESIGNS["fixed"], 12)
    assert exact is not None
    for a, b in product(range(13), repeat=2):
        assert (exact.winner(0, a, b) is not None) == (barnard(a, 12, b, 12).p <= 0.05)
    assert designs._of_scipy((0.3, 0.9), 12) == pytest.approx(exact_power(12, 0.3, 0.9))


@pytest.mark.parametrize("name", ["fixed", "late", "early_margin"])
def test_an_error_under_drift_is_that_of_constant_rates_where_there_is_none(name: str) -> None:
    exact = boundary_of(DESIGNS[name], 20)
    assert exact is not None
    margin = exact.margin or 0.0
    for rate in (0.2, 0.7):
        wrong = exact.operating_characteristics(margin + (1 - margin) * rate, (1 - margin) * rate).power
        assert errors_at(exact, np.full((1, 20), rate))[0] == pytest.approx(wrong)
    assert worst_drift(exact)[0] >= wrong


def test_an_error_under_drift_is_how_often_the_design_ends() -> None:
    case, pairs = DRIFTING["early_margin_at_0.1"]
    exact, rates = boundary_of(case, pairs), np.linspace(0.05, 0.4, pairs)
    assert exact is not None
    planned = design(rule=case.rule, blocks=pairs, alpha=case.alpha, margin=case.margin)
    chance, worse = np.random.default_rng(2), 0.8 * rates
    runs = chance.random((4000, pairs, 2)) < np.stack([worse, 0.2 + worse], axis=1)
    ended = sum(
        evaluate_design(planned, in_blocks([(float(a), float(b)) for a, b in run])).winner == "first"
        for run in runs
    )
    assert ended / 4000 == pytest.approx(float(errors_at(exact, rates[None])[0]), abs=0.02)
