"""Boundaries of designs with several looks: their error counted by hand, their power against published designs."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.boundaries import (
    SHAPES,
    Boundary,
    StoppingTable,
    boundary,
    extremeness_of,
    pair_counts,
)
from evaweb.statistics.planning import exact_power
from tests.examples import some

GROWTH = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)).filter(any), min_size=1, max_size=8)
MARGINS = st.sampled_from([None, 0.05, 0.1, 0.25])


def looks_of(growth):
    """Counts after each step, each arm tried at least once."""
    first, second = np.cumsum(growth, axis=0).T
    return [(int(n) + 1, int(m) + 1) for n, m in zip(first, second, strict=True)]


def stopped(found, outcomes):
    """Number of the look at which these outcomes (of each arm, in order) stop it, and for which arm."""
    for number, look in enumerate(found.looks):
        counts = sum(outcomes[0][: look.first]), sum(outcomes[1][: look.second])
        winner = found.winner(number, *counts)
        if winner:
            return number, winner
    return None


def counted(found, p, q):
    """The probability of a stop at each look, by all sequences of outcomes there are."""
    last = found.looks[-1]
    stops = [Fraction(0)] * len(found.looks)
    for one in product((0, 1), repeat=last.first):
        for other in product((0, 1), repeat=last.second):
            at = stopped(found, (one, other))
            if at:
                stops[at[0]] += (
                    p ** sum(one)
                    * (1 - p) ** (last.first - sum(one))
                    * (q ** sum(other) * (1 - q) ** (last.second - sum(other)))
                )
    return [float(stop) for stop in stops]


@pytest.mark.parametrize("looks", [pair_counts(5), pair_counts(6, [3]), [(1, 2), (3, 2), (4, 6)]])
@pytest.mark.parametrize("margin", [None, 0.3])
def test_the_course_is_that_of_all_sequences_there_are(looks, margin):
    found = boundary(looks, alpha=0.3, shape="early", margin=margin)
    for p, q in ((Fraction(1, 2), Fraction(1, 2)), (Fraction(1, 5), Fraction(9, 10))):
        assert found.operating_characteristics(float(p), float(q)).stops == pytest.approx(
            counted(found, p, q), abs=1e-12
        )
    assert any(look.least for look in found.looks)


@settings(max_examples=some(40))
@given(GROWTH, st.sampled_from([0.01, 0.05, 0.2]), st.sampled_from(sorted(SHAPES)), MARGINS)
def test_no_rates_of_the_null_stop_it_more_often_than_alpha(growth, alpha, shape, margin):
    found = boundary(looks_of(growth), alpha=alpha, shape=shape, margin=margin)
    highest, bound = found.error()
    assert highest <= bound <= alpha
    for p in (0.0, 0.01, 0.1, 0.37, 0.5, 0.9, 1.0):
        first, second = (p, p) if margin is None else (margin + (1 - margin) * p, (1 - margin) * p)
        assert found.operating_characteristics(first, second).power <= bound + 1e-12


@given(GROWTH, MARGINS.filter(bool))
@settings(max_examples=some(15))
def test_what_is_worse_by_more_than_the_margin_stops_less_often_still(growth, margin):
    found = boundary(looks_of(growth), alpha=0.1, margin=margin)
    bound = found.error()[1]
    rates = np.linspace(0, 1, 9)
    assert all(
        found.operating_characteristics(p, q).power <= bound for p in rates for q in rates if q <= p - margin
    )


@given(GROWTH, MARGINS)
@settings(max_examples=some(40))
def test_a_table_that_is_more_extreme_stops_too(growth, margin):
    found = boundary(looks_of(growth), alpha=0.2, shape="early", margin=margin)
    for number, look in enumerate(found.looks):
        for a, b in product(range(look.first + 1), range(look.second + 1)):
            won = found.winner(number, a, b)
            if won == "second":
                assert a == 0 or found.winner(number, a - 1, b) == "second"
                assert b == look.second or found.winner(number, a, b + 1) == "second"
            if won and margin is None and look.first == look.second:
                assert found.winner(number, b, a) == {"first": "second", "second": "first"}[won]


@pytest.mark.parametrize(
    ("shape", "pairs", "rates", "power", "median"),
    [
        ("late", 50, (0.5, 0.7), exact_power(50, 0.5, 0.7) - 0.05, 50),
        ("late", 50, (0.5, 0.8), exact_power(50, 0.5, 0.8) - 0.05, 50),
        # At least the power of STEP less 0.02, after at most a tenth more pairs (its figures at the same alpha).
        ("early", 50, (0.5, 0.7), 0.464 - 0.02, 50),
        ("early", 50, (0.5, 0.8), 0.838 - 0.02, 29 * 1.1),
        ("early", 100, (0.5, 0.7), 0.780 - 0.02, 68 * 1.1),
    ],
)
def test_power_and_median_are_those_that_are_wanted(shape, pairs, rates, power, median):
    found = boundary(pair_counts(pairs), shape=shape).operating_characteristics(*rates)
    assert found.power >= power
    assert found.median / 2 <= median
    assert found.second_better > 0.99 * found.power
    assert found.mean <= 2 * pairs


def test_fewer_looks_leave_more_of_alpha_to_the_last_one():
    every, one = boundary(pair_counts(40)), boundary(pair_counts(40, []))
    assert len(one.looks) == 1
    assert one.operating_characteristics(0.5, 0.8).power == pytest.approx(exact_power(40, 0.5, 0.8), abs=0.02)
    assert one.operating_characteristics(0.5, 0.8).median == 80
    assert every.operating_characteristics(0.5, 0.8).mean < 80


@given(st.integers(1, 250), st.integers(1, 250), st.lists(st.floats(0, 1), min_size=4, max_size=4), MARGINS)
def test_extremeness_is_the_statistic_in_whole_numbers(n, m, shares, margin):
    a, c = (round(share * n) for share in shares[:2])
    b, d = (round(share * m) for share in shares[2:])

    def statistic(a, b):
        if margin is None:
            pooled = (a + b) / (n + m)
            return (a / n - b / m) ** 2 / (pooled * (1 - pooled)) if 0 < pooled < 1 else 0.0
        p, q = (a + 1) / (n + 2), (b + 1) / (m + 2)
        lead = q - p + margin
        return lead * abs(lead) / (p * (1 - p) / (n + 2) + q * (1 - q) / (m + 2))

    one, other = Fraction(*extremeness_of(a, n, b, m, margin)), Fraction(*extremeness_of(c, n, d, m, margin))
    scale = float(n * m) ** 2 / (n + m) ** 2 if margin is None else 1.0
    assert float(one) == pytest.approx(scale * statistic(a, b), rel=1e-9, abs=1e-12)
    assert (one > other) == (statistic(a, b) > statistic(c, d)) or statistic(a, b) == pytest.approx(
        statistic(c, d), rel=1e-9
    )


@pytest.mark.parametrize(
    ("looks", "options", "words"),
    [
        ([], {}, "at least one look"),
        ([(1, 0)], {}, "after 1 and 0 trials; allowed: 1 to 250"),
        ([(251, 250)], {}, "after 251 and 250 trials"),
        ([(2, 2), (2, 2)], {}, r"after 2 and 2 trials follows one after \(2, 2\)"),
        ([(2, 2), (3, 1)], {}, "follows one after"),
        (pair_counts(3), {"alpha": 1.0}, "alpha = 1.0"),
        (pair_counts(3), {"shape": "flat"}, "shape = 'flat'; allowed: late, early"),
        (pair_counts(3), {"margin": 0.0}, "margin = 0.0; allowed: above 0 and below 1"),
    ],
)
def test_a_design_that_cannot_be_is_an_error_in_words(looks, options, words):
    with pytest.raises(StatisticsError, match=words):
        boundary(looks, **options)


def test_where_nothing_may_stop_nothing_does():
    found = Boundary((StoppingTable(2, 2, None), StoppingTable(3, 3, (0, 3))), 0.05)
    assert found.winner(0, 0, 2) is None
    assert found.winner(1, 3, 0) == "first"
    with pytest.raises(StatisticsError, match=r"p_first = 1\.2"):
        found.operating_characteristics(1.2, 0.5)
