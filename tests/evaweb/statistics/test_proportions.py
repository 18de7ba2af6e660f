import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.means import average
from evaweb.statistics.proportions import (
    StatisticsError,
    clopper_pearson,
    proportion,
    summary,
    wilson,
)

COUNTS = st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))
LEVELS = st.floats(0.5, 0.999)

PUBLISHED = [  # successes, n, Wilson, Clopper-Pearson, each 95 %
    (81, 263, (0.2553, 0.3662), (0.2527, 0.3676)),
    (15, 148, (0.0624, 0.1605), (0.0578, 0.1617)),
    (0, 20, (0.0, 0.1611), (0.0, 0.1684)),
    (1, 29, (0.0061, 0.1718), (0.0009, 0.1776)),
]


@pytest.mark.parametrize(("x", "n", "expected", "_exact"), PUBLISHED)
def test_wilson_gives_the_published_values(x, n, expected, _exact):
    found = wilson(x, n)
    assert (found.low, found.high) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize(("x", "n", "_score", "expected"), PUBLISHED)
def test_clopper_pearson_gives_the_published_values(x, n, _score, expected):
    found = clopper_pearson(x, n)
    assert (found.low, found.high) == pytest.approx(expected, abs=5e-5)


def test_wilson_of_eight_and_of_ten_out_of_ten():
    assert (wilson(8, 10).low, wilson(8, 10).high) == pytest.approx((0.490, 0.943), abs=5e-4)
    assert wilson(10, 10).low == pytest.approx(0.7225, abs=5e-5)
    assert wilson(10, 10).high == 1.0
    assert wilson(0, 10).low == 0.0


@given(COUNTS, LEVELS)
def test_both_intervals_are_those_of_scipy(counts, level):
    from scipy.stats import binomtest

    x, n = counts
    reference = binomtest(x, n)
    for ours, method in ((wilson, "wilson"), (clopper_pearson, "exact")):
        expected = reference.proportion_ci(level, method=method)
        found = ours(x, n, level)
        assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=1e-9)


@given(COUNTS, LEVELS)
def test_an_interval_lies_within_0_and_1_and_holds_the_rate(counts, level):
    x, n = counts
    for method in (wilson, clopper_pearson):
        found = method(x, n, level)
        assert 0.0 <= found.low <= x / n + 1e-12
        assert x / n - 1e-12 <= found.high <= 1.0


@given(COUNTS)
def test_failures_are_the_mirror_image_of_successes(counts):
    x, n = counts
    one, other = wilson(x, n), wilson(n - x, n)
    assert (one.low, one.high) == pytest.approx((1 - other.high, 1 - other.low), abs=1e-12)


@given(st.integers(0, 50), st.integers(0, 50))
def test_more_trials_at_the_same_rate_narrow_the_interval(x, failures):
    n = x + failures
    if n == 0:
        assert proportion(0, 0).interval is None
        return
    few, many = wilson(x, n), wilson(4 * x, 4 * n)
    assert many.high - many.low < few.high - few.low


def test_of_no_trials_nothing_is_known():
    nothing = summary([], [], [])
    assert nothing.success == proportion(0, 0)
    assert nothing.success.rate is None
    assert nothing.success.interval is None
    assert nothing.mean_score is None
    assert nothing.median_duration_s is None


def test_a_summary_counts_averages_and_takes_the_middle():
    found = summary([True, False, True, True], [1.0, 0.2, 1.0, 0.6], [4.0, 10.0, 6.0])
    assert (found.success.successes, found.success.n, found.success.rate) == (3, 4, 0.75)
    assert found.mean_score == pytest.approx(0.7)
    assert found.median_duration_s == 6.0
    assert found.smoothness is None
    assert summary([True, True], [1.0, 1.0], [], [-4.0, -5.0]).smoothness == average([-4.0, -5.0])


@pytest.mark.parametrize(("x", "n"), [(0, 0), (3, 2), (-1, 5), (0, -1)])
def test_counts_that_cannot_be_are_refused(x, n):
    with pytest.raises(StatisticsError):
        wilson(x, n)


@pytest.mark.parametrize("level", [0.0, 1.0, -0.5, float("nan")])
def test_levels_that_cannot_be_are_refused(level):
    with pytest.raises(StatisticsError, match="allowed: above 0 and below 1"):
        wilson(1, 2, level)


def test_the_module_needs_neither_django_nor_scipy_to_be_imported():
    program = (
        "import sys, evaweb.statistics.proportions; "
        "print([m for m in ('django', 'scipy', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
