import math

import pytest

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.preference import Comparison, NotIdentifiedError, preferences


def compared(cells, both_orders=False):
    """(first, second): (first preferred, second preferred, ties) as comparisons."""
    found = []
    for (first, second), (wins, losses, ties) in cells.items():
        found += [Comparison(first, second, "first")] * wins
        found += [Comparison(first, second, "second")] * losses
        found += [Comparison(first, second, "tie")] * ties
        if both_orders:
            found += [Comparison(second, first, "first")] * wins
            found += [Comparison(second, first, "second")] * losses
            found += [Comparison(second, first, "tie")] * ties
    return found


def test_two_policies_without_ties_are_a_coin():
    found = preferences(compared({("A", "B"): (30, 10, 0)}))
    contrast = found.contrasts["A", "B"]
    assert contrast.difference == pytest.approx(math.log(3))
    assert contrast.error == pytest.approx(math.sqrt(1 / 30 + 1 / 10))
    assert contrast.win_probability == pytest.approx(0.75)
    assert found.tie is None
    assert found.ranking == ["A", "B"]
    assert found.worth["A"] == pytest.approx(-found.worth["B"]) == pytest.approx(math.log(3) / 2)
    assert found.rating("A") == pytest.approx(1500 + 100 * math.log(3))


def test_at_the_solution_expected_and_observed_agree():
    cells = {("A", "B"): (7, 3, 2), ("B", "C"): (5, 4, 3), ("A", "C"): (8, 2, 1), ("C", "A"): (1, 3, 0)}
    found = preferences(compared(cells), order_effect=True)
    expected = dict.fromkeys("ABC", 0.0)
    ties = order = 0.0
    for (first, second), counts in cells.items():
        weights = [
            math.exp(found.worth[first] + found.order / 2),
            math.exp(found.worth[second] - found.order / 2),
            2 * found.tie * math.exp((found.worth[first] + found.worth[second]) / 2),
        ]
        p = [sum(counts) * w / sum(weights) for w in weights]
        expected[first] += p[0] + p[2] / 2
        expected[second] += p[1] + p[2] / 2
        ties += p[2]
        order += p[0] - p[1]
    observed = dict.fromkeys("ABC", 0.0)
    for (first, second), (wins, losses, tied) in cells.items():
        observed[first] += wins + tied / 2
        observed[second] += losses + tied / 2
    assert expected == pytest.approx(observed, abs=1e-6)
    assert ties == pytest.approx(6, abs=1e-6)
    assert order == pytest.approx((7 + 5 + 8 + 1) - (3 + 4 + 2 + 3), abs=1e-6)


def test_equal_policies_tie_with_nu_over_one_plus_nu():
    found = preferences(compared({("A", "B"): (4, 4, 4)}))
    assert found.tie / (1 + found.tie) == pytest.approx(1 / 3)


def test_order_is_told_from_worth_where_both_orders_were_shown():
    found = preferences(compared({("A", "B"): (12, 4, 3)}, both_orders=True), order_effect=True)
    assert found.worth["A"] == pytest.approx(0, abs=1e-8)
    assert found.order == pytest.approx(math.log(3))
    assert found.order_z > 2


@pytest.mark.parametrize(
    ("cells", "order"),
    [
        ({("A", "B"): (5, 0, 5)}, False),
        ({("A", "B"): (5, 0, 0), ("A", "C"): (5, 0, 0), ("B", "C"): (3, 3, 1)}, False),
        ({("A", "B"): (3, 3, 1), ("C", "D"): (3, 3, 1)}, False),
        ({("A", "B"): (4, 3, 2)}, True),
        ({("A", "B"): (0, 0, 3)}, False),
    ],
)
def test_what_is_not_identified_is_not_ranked(cells, order):
    with pytest.raises(NotIdentifiedError):
        preferences(compared(cells), order_effect=order)


def test_a_first_seen_one_that_always_wins_is_not_ranked():
    with pytest.raises(NotIdentifiedError):
        preferences(compared({("A", "B"): (4, 0, 1)}, both_orders=True), order_effect=True)


@pytest.mark.parametrize(
    "cells",
    [
        {("A", "B"): (5, 0, 1), ("A", "C"): (5, 0, 0), ("B", "C"): (3, 3, 1)},
        {("A", "B"): (5, 0, 5), ("C", "D"): (3, 3, 2), ("B", "C"): (2, 2, 1)},
        {("A", "B"): (3, 2, 0), ("B", "C"): (3, 2, 0), ("A", "C"): (1, 1, 0)},
    ],
)
def test_what_is_identified_is_finite(cells):
    found = preferences(compared(cells))
    assert all(math.isfinite(worth) and abs(worth) < 20 for worth in found.worth.values())


def test_components_come_with_the_refusal_best_first():
    with pytest.raises(NotIdentifiedError) as refused:
        preferences(compared({("A", "B"): (5, 0, 0), ("A", "C"): (5, 0, 0), ("B", "C"): (3, 3, 1)}))
    assert refused.value.components == (("A",), ("B", "C"))


def test_comparisons_that_cannot_be_are_refused():
    with pytest.raises(StatisticsError, match="'A' compared with itself"):
        preferences([Comparison("A", "A", "tie")])
    with pytest.raises(StatisticsError, match="outcome 'both'"):
        preferences([Comparison("A", "B", "both")])
    with pytest.raises(StatisticsError, match="no comparison"):
        preferences([])


def test_what_several_people_say_of_the_same_two_weighs_as_one():
    once = preferences(compared({("A", "B"): (30, 10, 4)}))
    thrice = preferences(
        [Comparison(one.first, one.second, one.outcome, 1 / 3) for one in compared({("A", "B"): (30, 10, 4)})]
        * 3
    )
    assert thrice.worth == pytest.approx(once.worth)
    assert thrice.error == pytest.approx(once.error)


@pytest.mark.parametrize("counts", [(8, 2, 0, 3, 5, 2), (12, 3, 10, 4, 10, 11), (14, 3, 8, 3, 13, 9)])
def test_the_fit_ends_where_the_likelihood_rises_by_less_than_it_is_rounded_by(counts):
    """Counts of first, second and tie, with a first and with b first."""
    said = [Comparison(*order, word) for order in ("ab", "ba") for word in ("first", "second", "tie")]
    rows = [row for row, count in zip(said, counts, strict=True) for _ in range(count)]
    found = preferences(rows, order_effect=True)
    assert found.worth["a"] > 0 > found.worth["b"]
