"""Power of designs of scores, against the designs themselves and what is known of them."""

import math
import random

import pytest

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.designs import design, evaluate_design, in_blocks
from evaweb.statistics.permutation import sign_flip_test
from evaweb.statistics.score_courses import (
    Scores,
    _differences,
    _flipped,
    score_course,
    score_pairs_needed,
)

SCORES = Scores(0.7, 0.5, 0.3, 4)


def moments(scores, mean):
    found = [(n / scores.points, chance) for n, chance in enumerate(scores.chances(mean))]
    first = sum(value * chance for value, chance in found)
    return first, math.sqrt(sum((value - first) ** 2 * chance for value, chance in found))


@pytest.mark.parametrize(
    ("scores", "spreads"),
    [
        (SCORES, (0.3, 0.3)),
        (Scores(0.9, 0.5, 0.45, 4), (0.3, 0.45)),  # more is not possible with that mean
        (Scores(0.8, 0.5, 0.01, 4), (0.2, 0.25)),  # points that are reached independently
        (Scores(1.0, 0.0, 0.3, 3), (0.0, 0.0)),
        (Scores(0.6, 0.3, 0.2, 1), (math.sqrt(0.24), math.sqrt(0.21))),
    ],
)
def test_assumed_scores_have_the_means_and_deviations_that_are_said(scores, spreads):
    assert scores.spreads() == pytest.approx(spreads)
    for mean, spread in zip((scores.first, scores.second), spreads, strict=True):
        assert sum(scores.chances(mean)) == pytest.approx(1)
        assert moments(scores, mean) == pytest.approx((mean, spread), abs=1e-9)


@pytest.mark.parametrize("pairs", [1, 5, 12, 40])
def test_the_test_of_all_evaluations_at_once_is_that_of_each(pairs):
    rows = _differences(SCORES)[:40, :pairs]
    expected = [sign_flip_test([int(d) / SCORES.points for d in row]).p for row in rows]
    assert _flipped(rows, SCORES.points) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("rule", ["none", "evidence"])
def test_the_power_is_how_often_the_design_itself_finds_a_winner(rule):
    runs, chance = 400, random.Random(3)
    found = design(rule=rule, blocks=30, alpha=0.05, outcome="score")
    ends = []
    for _ in range(runs):
        one, other = (chance.choices(range(5), SCORES.chances(mean), k=30) for mean in (0.7, 0.5))
        ends.append(
            evaluate_design(found, in_blocks([(a / 4, b / 4) for a, b in zip(one, other, strict=True)]))
        )
    share = sum(end.winner is not None for end in ends) / runs
    expected = score_course(rule, 30, SCORES, 0.05)
    assert share == pytest.approx(expected.power, abs=4 * math.sqrt(0.25 / runs))
    assert sum(end.ended_at_pair for end in ends) / runs == pytest.approx(expected.mean, abs=1.5)


def test_scores_of_one_point_are_the_sign_test_of_successes():
    """A pair counts where it differs, which it does with q = .3 * .5 + .7 * .5; the rest is a binomial of that."""
    pairs, ahead, behind = 20, 0.7 * 0.5, 0.3 * 0.5
    power = 0.0
    for differ in range(pairs + 1):
        for wins in range(differ + 1):
            tail = sum(math.comb(differ, k) for k in range(max(wins, differ - wins), differ + 1)) / 2**differ
            if min(1.0, 2 * tail) <= 0.05:
                rest = math.comb(pairs, differ) * (1 - ahead - behind) ** (pairs - differ)
                power += rest * math.comb(differ, wins) * ahead**wins * behind ** (differ - wins)
    found = score_course("none", pairs, Scores(0.7, 0.5, 0.3, 1), 0.05).power
    assert found == pytest.approx(power, abs=4 * math.sqrt(power * (1 - power) / 4000))


def test_equal_scores_are_told_apart_at_most_as_often_as_alpha():
    same = Scores(0.6, 0.6, 0.35, 5)
    for rule in ("none", "evidence"):
        assert score_course(rule, 40, same, 0.05).power <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 4000)


def test_the_fewest_pairs_of_a_power_and_none_where_there_are_too_few():
    found = score_pairs_needed("none", SCORES, 0.8, 0.05)
    assert found.power >= 0.8 > score_course("none", found.pairs - 2, SCORES, 0.05).power
    assert found.pairs < score_pairs_needed("evidence", SCORES, 0.8, 0.05).pairs
    assert score_pairs_needed("none", Scores(0.52, 0.5, 0.3, 4), 0.8, 0.05) is None


def test_what_is_not_allowed_is_said():
    for wrong, words in (
        (lambda: Scores(0.5, 0.7, 0.6, 4), "standard deviation = 0.6; allowed: 0 to 0.5"),
        (lambda: Scores(0.5, 0.7, 0.3, 11), "11 points; allowed: 1 to 10"),
        (
            lambda: score_course("late", 20, SCORES, 0.05),
            "design = 'late' of scores; allowed: none, evidence",
        ),
        (lambda: score_course("none", 251, SCORES, 0.05), "251 pairs; allowed: 1 to 250"),
    ):
        with pytest.raises(StatisticsError, match=words):
            wrong()
