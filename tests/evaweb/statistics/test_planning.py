import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.difference import barnard
from evaweb.statistics.planning import (
    MOST,
    _barnard_tables,
    _masses,
    approximate_power,
    detectable,
    exact_power,
    trials_needed,
)


def test_the_published_numbers_of_trials():
    assert trials_needed(0.5, 0.7) == 93
    assert trials_needed(0.6, 0.9) == 32
    assert approximate_power(50, 0.5, 0.75) == pytest.approx(0.740, abs=5e-4)


@given(st.integers(5, 95), st.integers(5, 95))
def test_so_many_trials_have_the_power_and_one_less_has_not(one, other):
    p1, p2 = one / 100, other / 100
    if p1 == p2:
        with pytest.raises(StatisticsError, match="difference that is not there"):
            trials_needed(p1, p2)
        return
    n = trials_needed(p1, p2)
    assert n == trials_needed(p2, p1)
    assert approximate_power(n, p1, p2) >= 0.8 - 1e-9
    if n > 1:
        assert approximate_power(n - 1, p1, p2) < 0.8


@pytest.mark.parametrize("counts", [(9, 3), (12, 7), (12, 12), (1, 0), (6, 2)])
def test_all_tables_at_once_agree_with_the_test_of_one(counts):
    found = _barnard_tables(12)[counts]
    assert found == pytest.approx(barnard(counts[0], 12, counts[1], 12).p, abs=2e-3)


def test_the_exact_test_is_rarely_wrong_and_its_power_is_near_the_approximation():
    for rate in (0.1, 0.3, 0.5, 0.8):
        assert exact_power(30, rate, rate) <= 0.05 + 1e-3
    assert exact_power(50, 0.5, 0.75) == pytest.approx(approximate_power(50, 0.5, 0.75), abs=0.03)
    with pytest.raises(StatisticsError, match="allowed: 1 to 250"):
        exact_power(251, 0.5, 0.6)


@pytest.mark.parametrize("n", [1, 2, 12, 41])
def test_the_masses_are_those_of_scipy_and_half_of_the_rates_says_all(n):
    rates = np.linspace(0, 1, 12)
    expected = binom.pmf(np.arange(n + 1)[None, :], n, rates[:, None])
    assert _masses(n, rates) == pytest.approx(expected, abs=1e-13)
    tables = _barnard_tables(n)
    assert np.array_equal(tables, tables.T)
    assert np.array_equal(tables, tables[::-1, ::-1])


def test_each_number_of_trials_is_computed_once():
    first = _barnard_tables(17)
    for n in range(1, 60):
        exact_power(n, 0.2, 0.6)
    assert _barnard_tables(17) is first
    assert _barnard_tables.cache_info().maxsize == MOST


def test_the_planner_does_not_wait_for_scipys_statistics():
    code = (
        "import sys; from evaweb.statistics.planning import exact_power; exact_power(30, .2, .6);"
        "sys.exit('scipy.stats' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_what_can_be_detected_has_just_the_power():
    gain = detectable(50, 0.5)
    assert gain is not None
    assert approximate_power(50, 0.5, 0.5 + gain) == pytest.approx(0.8, abs=1e-6)
    assert detectable(3, 0.9) is None
    assert detectable(50, 1.0) is None
