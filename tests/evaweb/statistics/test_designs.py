"""Designs: what ends them, what they conclude, and how often they are wrong where checkpoints are equal."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.boundaries import pair_counts
from evaweb.statistics.designs import (
    RULES,
    Conclusion,
    boundary_from_table,
    boundary_table,
    design,
    evaluate_design,
    findings,
    in_blocks,
)

BETTER, WORSE, SAME = (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)
PAIRS = st.lists(st.sampled_from([BETTER, WORSE, SAME, (0.0, 0.0)]), max_size=40)


def made(rule, pairs=20, **options):
    return design(rule=rule, blocks=pairs, alpha=0.05, **options)


def told(found, pairs):
    return evaluate_design(found, in_blocks(pairs))


@pytest.mark.parametrize("rule", RULES)
def test_before_its_pairs_are_made_nothing_is_said(rule):
    found = made(rule)
    assert told(found, []) == Conclusion(0, None, None, None, 20)
    assert told(found, [BETTER, WORSE]).ended == ""


def test_a_fixed_number_is_tested_once_at_its_end_however_clear_it_is_before():
    found = made("none")
    assert told(found, [BETTER] * 19) == Conclusion(19, None, None, None, 20)
    ended = told(found, [BETTER] * 20)
    assert (ended.ended_at_pair, ended.winner, ended.ended) == (
        20,
        "first",
        "full",
    )  # which tells nothing of what was found
    assert ended.p < 1e-6
    equal = told(found, [SAME] * 20)
    assert (equal.ended_at_pair, equal.winner, equal.ended, equal.p) == (20, None, "full", 1.0)


@pytest.mark.parametrize("rule", ["evidence", "late", "early"])
def test_a_boundary_ends_it_early_for_the_one_that_is_better(rule):
    for pairs, winner in (([BETTER] * 20, "first"), ([WORSE] * 20, "second")):
        ended = told(made(rule), pairs)
        assert (ended.winner, ended.ended) == (winner, "boundary")
        assert ended.ended_at_pair < 20
        assert told(made(rule), pairs[: ended.ended_at_pair - 1]).ended == ""
        # What was under way when it ended changes nothing.
        assert (
            told(made(rule), pairs[: ended.ended_at_pair] + [SAME] * 5).ended_at_pair == ended.ended_at_pair
        )
    full = told(made(rule), [SAME] * 20)
    assert (full.ended_at_pair, full.winner, full.ended) == (20, None, "full")


def test_scores_end_it_where_success_alone_would_not():
    values = [(0.9, 0.2)] * 60
    assert told(made("evidence", 60, outcome="score"), values).winner == "first"
    assert told(made("evidence", 60), [(0.0, 0.0)] * 60).winner is None


def test_a_fixed_number_of_scores_is_tested_by_scores_not_by_whether_they_are_above_0():
    found = made("none", 20, outcome="score")
    ended = told(found, [(0.9, 0.2)] * 20)
    assert (ended.ended_at_pair, ended.winner) == (20, "first")
    assert ended.p == pytest.approx(2 / 2**20)
    assert told(found, [(0.2, 0.9)] * 20).winner == "second"
    # Seldom above 0, but then far: success alone would call the second better.
    assert told(found, [(0.5, 0.4)] * 10 + [(0.0, 0.1)] * 10).winner is None


def test_not_worse_by_the_margin_is_asked_of_the_first():
    found = made("late", 60, margin=0.2)
    assert told(found, [BETTER] * 60).winner == "first"
    assert told(found, [WORSE] * 60).winner is None
    equal = [SAME, (0.0, 0.0)] * 30
    assert told(made("none", 60, margin=0.3), equal).winner == "first"


def test_looks_that_are_named_are_the_only_ones():
    found = made("early", 30, looks=[10, 20])
    assert [look.first for look in found.boundary.looks] == [10, 20, 30]
    assert told(found, [BETTER] * 9).ended == ""
    assert told(found, [BETTER] * 15).ended_at_pair == 10


@given(PAIRS, st.sampled_from(["none", "evidence", "late", "early"]))
def test_mirrored_pairs_end_it_for_the_other_one_at_the_same_pair(pairs, rule):
    found = made(rule, 12)
    here, there = told(found, pairs), told(found, [(other, one) for one, other in pairs])
    assert here.ended_at_pair == there.ended_at_pair
    assert {here.winner, there.winner} in ({None}, {"first", "second"})


@pytest.mark.parametrize("margin", [None, 0.1])
def test_a_boundary_comes_back_from_the_plan_as_it_was(margin):
    found = made("early", 25, looks=[5, 15], margin=margin).boundary
    rows = boundary_table(found)
    assert boundary_from_table(rows, found.alpha, margin) == found
    assert all(type(number) is int for row in rows for number in row)


@pytest.mark.some(3)
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
        wrong += told(found, pairs).winner is not None
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
    assert made("none", 5000).blocks == 5000
    assert pair_counts(3, [1]) == [(1, 1), (3, 3)]


# --- several comparisons ----------------------------------------------------------------------------------------

ALL_OF_THREE = ((0, 1), (0, 2), (1, 2))
OUTCOMES = st.lists(st.lists(st.booleans(), min_size=3, max_size=3), min_size=1, max_size=20)


def blocks_of_three(rows):
    return [tuple((arm, float(won)) for arm, won in enumerate(row)) for row in rows]


@pytest.mark.parametrize("rule", RULES)
def test_each_of_several_comparisons_has_its_share_of_alpha(rule):
    found = made(rule, comparisons=ALL_OF_THREE)
    alone = design(rule=rule, blocks=20, alpha=0.05 / 3)
    rows = [(True, number % 3 > 0, number % 2 > 0) for number in range(20)]
    said = findings(found, blocks_of_three(rows))
    for (one, other), conclusion in zip(ALL_OF_THREE, said.each, strict=True):
        pairs = [(float(row[one]), float(row[other])) for row in rows]
        assert conclusion == told(alone, pairs)
    if found.boundary:
        assert found.boundary.error()[1] <= 0.05 / 3


def test_several_comparisons_with_one_test_are_decided_step_by_step():
    counts = (17, 10, 9)  # successes of 20
    rows = [[at < count for count in counts] for at in range(20)]
    equal, stepped = (made("none", comparisons=ALL_OF_THREE, holm=holm) for holm in (False, True))
    said = findings(equal, blocks_of_three(rows)).each
    assert said[1].p <= 0.05 / 3 < said[0].p <= 0.05 / 2
    assert [one.winner for one in said] == [None, "first", None]
    assert [one.winner for one in findings(stepped, blocks_of_three(rows)).each] == ["first", "first", None]
    assert findings(stepped, blocks_of_three(rows[:-1])) == findings(equal, blocks_of_three(rows[:-1]))


def test_a_checkpoint_that_was_found_worse_is_dropped_and_the_others_go_on():
    found = made("early", 40, comparisons=ALL_OF_THREE, drops=True)
    rows = [(True, number % 2 > 0, False) for number in range(40)]
    said = findings(found, blocks_of_three(rows))
    arm, at = min(said.dropped.items(), key=lambda each: each[1])
    assert arm == 2
    # From then on its trials are no part of it, whatever is made of them.
    left = [row[: 3 if number < at else 2] for number, row in enumerate(rows)]
    assert findings(found, blocks_of_three(left)) == said
    assert said.each[1].winner == "first"
    assert said.ended


def test_a_comparison_ends_with_the_checkpoint_that_was_dropped():
    found = made("early", 40, comparisons=ALL_OF_THREE, drops=True)
    rows = [(True, number % 2 > 0, False) for number in range(40)]
    said = findings(found, blocks_of_three(rows))
    by_itself = findings(made("early", 40, comparisons=ALL_OF_THREE), blocks_of_three(rows))
    third = said.each[2]
    assert (third.winner, third.dropped, third.ended_at_pair) == (None, True, said.dropped[2])
    assert by_itself.each[2].winner == "first"  # and was not waited for
    assert by_itself.each[2].ended_at_pair > third.ended_at_pair


@pytest.mark.parametrize("margin", [None, 0.3])
def test_a_control_stays_and_each_comparison_with_it_ends_by_itself(margin):
    star = {"comparisons": ((1, 0), (2, 0)), "margin": margin}
    rows = [(False, True, number % 2 > 0) for number in range(30)]
    said = findings(made("late", 30, **star, drops=True), blocks_of_three(rows))
    by_itself = findings(made("late", 30, **star), blocks_of_three(rows))
    assert [(one.winner, one.ended_at_pair) for one in said.each] == [
        (one.winner, one.ended_at_pair) for one in by_itself.each
    ]
    assert said.dropped[1] == said.each[0].ended_at_pair < said.each[1].ended_at_pair == said.dropped[0]
    assert not any(one.dropped for one in said.each)


@given(OUTCOMES, st.sampled_from(["evidence", "late", "early"]), st.randoms())
def test_what_was_found_does_not_depend_on_who_finished_first(rows, rule, chance):
    """Trials come in any order: what is dropped on the way is dropped at the end, at the same block."""
    found = made(rule, 20, comparisons=ALL_OF_THREE, drops=True)
    whole = findings(found, blocks_of_three(rows))
    trials = [(block, arm) for block in range(len(rows)) for arm in range(3)]
    chance.shuffle(trials)
    there, before = set(), {}
    for trial in trials:
        there.add(trial)
        partly = [
            tuple((arm, float(row[arm])) for arm in range(3) if (block, arm) in there)
            for block, row in enumerate(rows)
        ]
        said = findings(found, partly)
        assert before.items() <= said.dropped.items()
        assert said.dropped.items() <= whole.dropped.items()
        before = said.dropped
    assert before == whole.dropped


@pytest.mark.parametrize("drops", [False, True])
def test_any_of_several_equal_checkpoints_is_called_better_at_most_as_often_as_alpha(drops):
    found, chance, runs = made("early", 30, comparisons=ALL_OF_THREE, drops=drops), random.Random(3), 600
    wrong = 0
    for _ in range(runs):
        rows = [[chance.random() < 0.5 for _ in range(3)] for _ in range(30)]
        wrong += any(one.winner for one in findings(found, blocks_of_three(rows)).each)
    assert wrong <= 0.05 * runs + 3 * (0.05 * 0.95 * runs) ** 0.5


# --- two arms in random order -----------------------------------------------------------------------------------


def in_random_order(chance, rates, blocks=30):
    """Blocks of two trials of whichever is drawn, and how many there were of each."""
    made_of, counts, total = [], [], [0, 0]
    for _ in range(blocks):
        arms = [chance.randrange(2), chance.randrange(2)]
        made_of.append(tuple((arm, float(chance.random() < rates[arm])) for arm in arms))
        for arm in arms:
            total[arm] += 1
        counts.append((total[0], total[1]))
    return made_of, counts


@pytest.mark.parametrize("rule", ["none", "late", "early"])
def test_two_arms_in_random_order_are_judged_by_the_counts_that_were_drawn(rule):
    blocks, counts = in_random_order(random.Random(5), (1.0, 0.0))
    found = made(rule, 30, counts=counts)
    said = evaluate_design(found, blocks)
    assert said.winner == "first"
    assert (
        evaluate_design(found, [[(1 - arm, value) for arm, value in block] for block in blocks]).blocks < 30
    )
    assert evaluate_design(found, [*blocks[:10], blocks[10][:1], *blocks[11:]]).blocks == 10
    if rule != "none":
        assert said.ended_at_pair < 30
        assert [look.first + look.second for look in found.boundary.looks][-1] == 60
        assert found.boundary.error()[1] <= 0.05


def test_two_arms_in_random_order_that_are_equal_are_told_apart_at_most_as_often_as_alpha():
    chance, runs, wrong = random.Random(8), 600, 0
    _, counts = in_random_order(chance, (0.5, 0.5))
    found = made("early", 30, counts=counts)
    arms = [
        [0] * (after[0] - before[0]) + [1] * (after[1] - before[1])
        for before, after in zip([(0, 0), *counts], counts, strict=False)
    ]
    for _ in range(runs):
        rates = [chance.choice((0.2, 0.5, 0.8)) for _ in range(30)]
        blocks = [
            [(arm, float(chance.random() < rate)) for arm in of] for rate, of in zip(rates, arms, strict=True)
        ]
        wrong += evaluate_design(found, blocks).winner is not None
    assert wrong <= 0.05 * runs + 3 * (0.05 * 0.95 * runs) ** 0.5


def test_not_worse_by_the_margin_is_asked_in_random_order_too():
    chance = random.Random(2)
    blocks, counts = in_random_order(chance, (1.0, 1.0), 40)
    found = made("late", 40, counts=counts, margin=0.3)
    assert evaluate_design(found, blocks).winner == "first"
    worse = [[(arm, float(arm == 1)) for arm, _ in block] for block in blocks]
    assert evaluate_design(found, worse).winner is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"rule": "none", "drops": True, "comparisons": ALL_OF_THREE},
            "arms are dropped with the design 'none'",
        ),
        ({"rule": "early", "drops": True}, "arms are dropped with 1 comparison"),
        (
            {"rule": "evidence", "counts": [(1, 1)]},
            "two arms in random order; allowed with: success, one comparison",
        ),
        ({"rule": "early", "counts": [(2, 0)] * 20}, "a design needs at least one look"),
    ],
)
def test_what_cannot_go_together_is_said(options, words):
    with pytest.raises(StatisticsError, match=words):
        made(**options)
