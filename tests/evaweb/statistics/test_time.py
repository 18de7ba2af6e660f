import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.rates import rate
from evaweb.statistics.smoothness import sparc
from evaweb.statistics.success_times import cumulative_incidence, restricted_mean

TIMES = st.lists(st.one_of(st.none(), st.floats(0, 60)), min_size=1, max_size=40)


def test_the_curve_counts_all_trials_at_every_time():
    found = cumulative_incidence([5.0, None, 10.0, 10.0, None], until=40.0)
    assert found.times == (5.0, 10.0)
    assert found.share == pytest.approx((0.2, 0.6))
    assert (found.low[1], found.high[1]) == pytest.approx((0.2307, 0.8824), abs=1e-4)  # Wilson, 3 of 5
    assert (found.n, found.successes, found.median) == (5, 3, 10.0)


def test_a_failure_counts_in_full_and_so_does_a_success_after_the_horizon():
    found = restricted_mean([2.0, None, 9.0], until=6.0, seed=1)
    assert found.value == pytest.approx((2 + 6 + 6) / 3)
    assert found.interval.low < found.value < found.interval.high <= 6.0
    assert cumulative_incidence([2.0, None, 9.0], until=6.0).successes == 1
    assert cumulative_incidence([None, 9.0], until=6.0).median is None


@given(TIMES, st.floats(1, 60))
def test_the_restricted_mean_is_the_area_above_the_curve(times, until):
    found, curve = restricted_mean(times, until, seed=1), cumulative_incidence(times, until)
    steps = [0.0, *curve.times, until]
    areas = [
        (1 - share) * (after - t)
        for share, t, after in zip([0.0, *curve.share], steps[:-1], steps[1:], strict=True)
    ]
    assert found.value == pytest.approx(sum(areas), abs=1e-9)
    assert 0 <= found.interval.low <= found.value + 1e-9
    assert found.value - 1e-9 <= found.interval.high <= until


@given(TIMES)
def test_at_the_horizon_the_curve_is_the_success_rate(times):
    curve = cumulative_incidence(times, until=60.0)
    assert curve.successes == sum(t is not None for t in times)
    assert all(one < other for one, other in zip(curve.share, curve.share[1:], strict=False))


@pytest.mark.parametrize(
    ("times", "until", "said"),
    [
        ([], 5.0, "no trial"),
        ([-1.0], 5.0, "a time to success of -1"),
        ([math.nan], 5.0, "nan"),
        ([1.0], 0.0, r"until = 0\.0 s; allowed: above 0"),
    ],
)
def test_times_that_cannot_be_are_refused(times, until, said):
    with pytest.raises(StatisticsError, match=said):
        cumulative_incidence(times, until)


def test_rates_have_garwoods_interval():
    found = rate(10, 3600.0)
    assert found.per_hour == pytest.approx(10)
    assert (found.interval.low, found.interval.high) == pytest.approx((4.7954, 18.3904), abs=1e-3)
    assert found.mean_time == pytest.approx(360)
    assert found.mean_time_interval.low == pytest.approx(3600 / 18.3904, abs=0.02)
    none = rate(0, 7200.0)
    assert none.interval.low == 0
    assert none.interval.high == pytest.approx(3.6889 / 2, abs=1e-3)
    assert none.mean_time is None
    assert none.mean_time_interval.high == math.inf
    with pytest.raises(StatisticsError, match="exposure = 0"):
        rate(1, 0)


def test_sparc_of_the_published_profile():
    t = np.arange(-1, 1, 0.01)
    assert sparc(np.exp(-5 * t**2), 100) == pytest.approx(-1.41403, abs=2e-3)


def test_a_movement_in_pieces_is_less_smooth_and_size_does_not_matter():
    t = np.arange(0, 2, 0.01)
    one = np.exp(-8 * (t - 1) ** 2)
    two = np.exp(-20 * (t - 0.5) ** 2) + np.exp(-20 * (t - 1.5) ** 2)
    assert sparc(two, 100) < sparc(one, 100) < 0
    assert sparc(7 * one, 100) == pytest.approx(sparc(one, 100))


def test_smoothness_of_standing_still_is_not_defined():
    with pytest.raises(StatisticsError, match="nothing moved"):
        sparc([0.0] * 10, 30)
    with pytest.raises(StatisticsError, match="at least 2"):
        sparc([1.0], 30)
