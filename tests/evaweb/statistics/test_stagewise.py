"""The estimate after an early stop, weighed over every way in which a small design can end."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.boundaries import boundary, pair_counts
from evaweb.statistics.difference import newcombe
from evaweb.statistics.stagewise import stagewise

PAIRS = 12


@cache
def design(shape):
    return boundary(pair_counts(PAIRS), shape=shape)


@cache
def ends(shape, rates):
    """Every table at which the design ends at these rates, with its trials, winner and probability."""
    found, alive, rows = design(shape), {(0, 0): 1.0}, []
    for number, look in enumerate(found.looks):
        grown = {}
        for (a, b), mass in alive.items():
            for one in (0, 1):
                for other in (0, 1):
                    share = (rates[0] if one else 1 - rates[0]) * (rates[1] if other else 1 - rates[1])
                    grown[a + one, b + other] = grown.get((a + one, b + other), 0.0) + mass * share
        alive = {}
        for (a, b), mass in grown.items():
            winner = found.winner(number, a, b)
            if winner or number == PAIRS - 1:
                rows.append((a, look.first, b, look.second, winner, mass))
            else:
                alive[a, b] = mass
    assert sum(row[-1] for row in rows) == pytest.approx(1.0)
    return rows


@pytest.mark.parametrize("shape", ["late", "early"])
@pytest.mark.parametrize("rates", [(0.5, 0.5), (0.8, 0.4), (0.3, 0.9)])
def test_it_is_as_often_too_large_as_too_small_and_its_interval_holds(shape, rates):
    truth, mass = rates[0] - rates[1], np.array([row[-1] for row in ends(shape, rates)])
    found = [stagewise(design(shape), *row[:4]) for row in ends(shape, rates)]
    values = np.array([one.value for one in found])
    assert mass[values > truth + 0.02].sum() <= 0.55
    assert mass[values < truth - 0.02].sum() <= 0.55
    held = [one.interval.low <= truth <= one.interval.high for one in found]
    assert mass[held].sum() >= 0.94


def test_where_it_stops_early_the_raw_difference_is_too_large_and_the_estimate_less_so():
    rates = (0.8, 0.4)
    rows = [row for row in ends("early", rates) if row[4] == "first"]
    mass = np.array([row[-1] for row in rows])
    raw = np.array([a / n - b / m for a, n, b, m, *_ in rows])
    estimate = np.array([stagewise(design("early"), *row[:4]).value for row in rows])
    assert (mass @ raw) / mass.sum() > 0.4 + 0.15
    assert (raw >= estimate - 1e-6).all()


def test_of_one_look_it_is_the_raw_difference_but_for_what_is_between_tables():
    one = boundary([(20, 20)])
    found, plain = stagewise(one, 12, 20, 9, 20), newcombe(12, 20, 9, 20)
    assert found.value == pytest.approx(plain.value, abs=0.01)
    assert found.interval.low == pytest.approx(plain.interval.low, abs=0.05)
    assert found.interval.high == pytest.approx(plain.interval.high, abs=0.05)


def test_the_arms_exchanged_it_is_the_same_the_other_way_round():
    for a, n, b, m, *_ in ends("late", (0.8, 0.4)):
        one, other = stagewise(design("late"), a, n, b, m), stagewise(design("late"), b, m, a, n)
        assert one.value == pytest.approx(-other.value, abs=1e-6)
        assert one.interval.low == pytest.approx(-other.interval.high, abs=1e-6)


def test_where_a_design_has_not_ended_there_is_none():
    with pytest.raises(StatisticsError, match="goes on after 3/5 and 2/5"):
        stagewise(design("late"), 3, 5, 2, 5)
    with pytest.raises(StatisticsError, match="no look of this design is after 3 and 4 trials"):
        stagewise(design("late"), 3, 3, 2, 4)
