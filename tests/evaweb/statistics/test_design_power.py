"""Courses of designs at assumed rates, against what is known of each."""

import random

import pytest

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.design_power import design_power, pairs_needed
from evaweb.statistics.planning import exact_power
from evaweb.statistics.sequential import success_evidence


def test_a_fixed_number_has_the_power_of_its_test_and_makes_all_pairs():
    found = design_power("none", 50, 0.5, 0.7, 0.05)
    assert (found.power, found.mean, found.median) == (exact_power(50, 0.5, 0.7), 50.0, 50)


def test_the_e_process_is_simulated_as_it_is_carried_out():
    found, chance, runs = design_power("evidence", 50, 0.5, 0.8, 0.05), random.Random(1), 600
    stops = [
        success_evidence([(chance.random() < 0.5, chance.random() < 0.8) for _ in range(50)]).stop
        for _ in range(runs)
    ]
    share = sum(stop is not None for stop in stops) / runs
    assert found.power == pytest.approx(0.607, abs=0.02)  # of four thousand runs
    assert share == pytest.approx(found.power, abs=4 * (0.24 / runs) ** 0.5)
    assert sum(stop or 50 for stop in stops) / runs == pytest.approx(found.mean, abs=2.5)


def test_equal_rates_are_told_apart_at_most_as_often_as_alpha():
    for rule in ("none", "late", "early", "evidence"):
        assert design_power(rule, 30, 0.4, 0.4, 0.05).power <= 0.05


def test_of_the_designs_the_e_process_needs_most_and_early_fewest_on_average():
    needed = {rule: pairs_needed(rule, 0.5, 0.8, 0.8, 0.05) for rule in ("none", "late", "early", "evidence")}
    assert all(found.power >= 0.8 for found in needed.values())
    assert needed["none"].pairs <= needed["late"].pairs <= needed["early"].pairs < needed["evidence"].pairs
    assert needed["early"].mean < needed["late"].mean < needed["none"].pairs


def test_what_takes_more_pairs_than_are_computed_is_none():
    assert pairs_needed("none", 0.5, 0.55, 0.9, 0.05) is None
    for wrong, words in (
        (lambda: pairs_needed("late", 0.5, 0.5, 0.8, 0.05), "there is no difference"),
        (lambda: design_power("late", 251, 0.5, 0.7, 0.05), "251 pairs; allowed: 1 to 250"),
        (lambda: design_power("never", 20, 0.5, 0.7, 0.05), "design = 'never'"),
    ):
        with pytest.raises(StatisticsError, match=words):
            wrong()


def test_with_a_margin_it_is_found_that_the_first_is_not_worse():
    level, ahead = (design_power("none", 60, better, 0.7, 0.05, 0.2).power for better in (0.7, 0.9))
    assert level < ahead
    assert design_power("none", 60, 0.5, 0.7, 0.05, 0.2).power <= 0.05
    assert design_power("none", 60, 0.7, 0.7, 0.05, 0.3).power > level
    with pytest.raises(StatisticsError, match=r"margin = 0\.2 with the design 'evidence'"):
        design_power("evidence", 60, 0.7, 0.7, 0.05, 0.2)


def test_of_fewer_looks_more_trials_are_made():
    often, seldom = (design_power("early", 40, 0.9, 0.4, 0.05, None, looks) for looks in ((), (20,)))
    assert often.mean < seldom.mean
    assert seldom.median == 20
