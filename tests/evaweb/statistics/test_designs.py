"""Designs: what ends them, what they conclude, and how often they are wrong where checkpoints are equal."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.boundaries import in_pairs
from evaweb.statistics.designs import RULES, Conclusion, conclude, design, of_table, table

BETTER, WORSE, SAME = (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)
PAIRS = st.lists(st.sampled_from([BETTER, WORSE, SAME, (0.0, 0.0)]), max_size=40)


def made(rule, pairs=20, **options):
    return design(rule=rule, pairs=pairs, alpha=0.05, **options)


@pytest.mark.parametrize("rule", RULES)
def test_before_its_pairs_are_made_nothing_is_said(rule):
    found = made(rule)
    assert conclude(found, []) == Conclusion(0, None, None, None, 20)
    assert conclude(found, [BETTER, WORSE]).ended == ""


def test_a_fixed_number_is_tested_once_at_its_end_however_clear_it_is_before():
    found = made("none")
    assert conclude(found, [BETTER] * 19) == Conclusion(19, None, None, None, 20)
    ended = conclude(found, [BETTER] * 20)
    assert (ended.at, ended.winner, ended.ended) == (
        20,
        "first",
        "full",
    )  # which tells nothing of what was found
    assert ended.p < 1e-6
    equal = conclude(found, [SAME] * 20)
    assert (equal.at, equal.winner, equal.ended, equal.p) == (20, None, "full", 1.0)


@pytest.mark.parametrize("rule", ["evidence", "late", "early"])
def test_a_boundary_ends_it_early_for_the_one_that_is_better(rule):
    for pairs, winner in (([BETTER] * 20, "first"), ([WORSE] * 20, "second")):
        ended = conclude(made(rule), pairs)
        assert (ended.winner, ended.ended) == (winner, "boundary")
        assert ended.at < 20
        assert conclude(made(rule), pairs[: ended.at - 1]).ended == ""
        # What was under way when it ended changes nothing.
        assert conclude(made(rule), pairs[: ended.at] + [SAME] * 5).at == ended.at
    full = conclude(made(rule), [SAME] * 20)
    assert (full.at, full.winner, full.ended) == (20, None, "full")


def test_scores_end_it_where_success_alone_would_not():
    values = [(0.9, 0.2)] * 60
    assert conclude(made("evidence", 60, outcome="score"), values).winner == "first"
    assert conclude(made("evidence", 60), [(0.0, 0.0)] * 60).winner is None


def test_a_fixed_number_of_scores_is_tested_by_scores_not_by_whether_they_are_above_0():
    found = made("none", 20, outcome="score")
    ended = conclude(found, [(0.9, 0.2)] * 20)
    assert (ended.at, ended.winner) == (20, "first")
    assert ended.p == pytest.approx(2 / 2**20)
    assert conclude(found, [(0.2, 0.9)] * 20).winner == "second"
    # Seldom above 0, but then far: success alone would call the second better.
    assert conclude(found, [(0.5, 0.4)] * 10 + [(0.0, 0.1)] * 10).winner is None


def test_not_worse_by_the_margin_is_asked_of_the_first():
    found = made("late", 60, margin=0.2)
    assert conclude(found, [BETTER] * 60).winner == "first"
    assert conclude(found, [WORSE] * 60).winner is None
    equal = [SAME, (0.0, 0.0)] * 30
    assert conclude(made("none", 60, margin=0.3), equal).winner == "first"


def test_looks_that_are_named_are_the_only_ones():
    found = made("early", 30, looks=[10, 20])
    assert [look.first for look in found.boundary.looks] == [10, 20, 30]
    assert conclude(found, [BETTER] * 9).ended == ""
    assert conclude(found, [BETTER] * 15).at == 10


@given(PAIRS, st.sampled_from(["none", "evidence", "late", "early"]))
def test_mirrored_pairs_end_it_for_the_other_one_at_the_same_pair(pairs, rule):
    found = made(rule, 12)
    here, there = conclude(found, pairs), conclude(found, [(other, one) for one, other in pairs])
    assert here.at == there.at
    assert {here.winner, there.winner} in ({None}, {"first", "second"})


@pytest.mark.parametrize("margin", [None, 0.1])
def test_a_boundary_comes_back_from_the_plan_as_it_was(margin):
    found = made("early", 25, looks=[5, 15], margin=margin).boundary
    rows = table(found)
    assert of_table(rows, found.alpha, margin) == found
    assert all(type(number) is int for row in rows for number in row)


@pytest.mark.parametrize(
    ("rates", "drift"), [((0.1, 0.9), 0.0), ((0.3, 0.5, 0.7), 0.0), ((0.2, 0.8), 0.2), ((0.5,), 0.0)]
)
@pytest.mark.parametrize("rule", ["none", "evidence", "late", "early"])
def test_equal_checkpoints_are_told_apart_at_most_as_often_as_alpha_whatever_the_conditions(
    rule, rates, drift
):
    """Rates differ by condition and drift over the day, as they do in a lab: the same for both of a pair."""
    found, chance, runs = made(rule, 40), random.Random(f"{rule}{rates}{drift}"), 600
    wrong = 0
    for _ in range(runs):
        pairs = []
        for number in range(40):
            rate = rates[number % len(rates)] * (1 - drift) + drift * number / 40
            pairs.append((float(chance.random() < rate), float(chance.random() < rate)))
        wrong += conclude(found, pairs).winner is not None
    assert wrong <= 0.05 * runs + 3 * (0.05 * 0.95 * runs) ** 0.5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rule": "often"}, "design = 'often'; allowed: none, evidence, late, early"),
        ({"rule": "late", "outcome": "score"}, "outcome = 'score' with a boundary of successes"),
        ({"rule": "evidence", "margin": 0.1}, "margin = 0.1 with the design 'evidence'"),
        ({"rule": "none", "looks": [5]}, r"looks = \[5\] with the design 'none'; allowed with: late, early"),
        ({"rule": "late", "looks": [5, 21]}, "from 1 to 20"),
        ({"rule": "late", "pairs": 251}, "251 pairs of a design with an exact boundary; allowed: 1 to 250"),
        ({"rule": "none", "outcome": "time"}, "outcome = 'time'; allowed: success, score"),
        ({"rule": "none", "pairs": 0}, "0 pairs; allowed: 1 or more"),
    ],
)
def test_a_design_that_cannot_be_is_an_error_in_words(options, words):
    with pytest.raises(StatisticsError, match=words):
        made(**{"pairs": 20, **options})


def test_a_fixed_number_may_be_large():
    assert made("none", 5000).pairs == 5000
    assert in_pairs(3, [1]) == [(1, 1), (3, 3)]
