import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.rates import rate
from evaweb.statistics.smoothness import sparc
from evaweb.statistics.survival import kaplan_meier, log_rank, restricted_mean

# Times of remission under 6-MP (Freireich et al. 1963), in weeks; the textbook example of censoring.
WEEKS = [6, 6, 6, 6, 7, 9, 10, 10, 11, 13, 16, 17, 19, 20, 22, 23, 25, 32, 32, 34, 35]
ENDED = [1, 1, 1, 0, 1, 0, 1, 0, 0, 1, 1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0]
PLACEBO = [1, 1, 2, 2, 3, 4, 4, 5, 5, 8, 8, 8, 8, 11, 11, 12, 12, 15, 17, 22, 23]


def test_the_textbook_curve():
    found = kaplan_meier(WEEKS, list(map(bool, ENDED)))
    at = dict(zip(found.times, found.share, strict=True))
    assert at[6] == pytest.approx(0.857, abs=5e-4)
    assert at[10] == pytest.approx(0.753, abs=5e-4)
    assert at[23] == pytest.approx(0.448, abs=5e-4)
    assert found.median == 23
    assert (found.n, found.successes) == (21, 9)
    assert found.at_risk[0] == 21


def test_the_textbook_comparison():
    p = log_rank((WEEKS, list(map(bool, ENDED))), (PLACEBO, [True] * 21))
    assert p == pytest.approx(4.17e-5, rel=0.02)
    assert log_rank(([5.0], [False]), ([6.0], [False])) == 1.0


def test_without_cut_off_trials_the_restricted_mean_is_the_mean():
    found = restricted_mean([2.0, 4.0, 6.0], [True] * 3, until=6.0)
    assert found.value == pytest.approx(4.0)
    assert found.interval.low < 4.0 < found.interval.high
    assert restricted_mean([2.0, 4.0, 6.0], [True] * 3, until=3.0).value == pytest.approx(2 + 2 / 3)


@given(st.lists(st.tuples(st.floats(0.5, 60), st.booleans()), min_size=1, max_size=40))
@example([(1.337885692909179, False), (33.75138534978009, False)])  # whose areas come to a rounding more
def test_a_restricted_mean_is_the_area_under_the_curve(trials):
    durations, succeeded = zip(*trials, strict=True)
    until = max(durations)
    found = restricted_mean(durations, succeeded, until)
    assert 0 <= found.interval.low <= found.value <= found.interval.high <= until + 1e-9
    curve = kaplan_meier(durations, succeeded)
    grid = np.linspace(0, until, 20001)
    steps = np.array([1.0, *curve.share])[np.searchsorted(curve.times, grid, side="right")]
    assert found.value == pytest.approx(float(np.trapezoid(steps, grid)), abs=0.01)


def test_nobody_succeeded_the_curve_stays_at_1():
    found = kaplan_meier([10.0, 20.0], [False, False])
    assert set(found.share) == {1.0}
    assert found.median is None


@pytest.mark.parametrize(
    ("durations", "succeeded", "said"),
    [
        ([], [], "no trial"),
        ([-1.0], [True], "duration -1"),
        ([1.0], [], "1 durations of 0"),
        ([math.nan], [True], "nan"),
    ],
)
def test_times_that_cannot_be_are_refused(durations, succeeded, said):
    with pytest.raises(StatisticsError, match=said):
        kaplan_meier(durations, succeeded)


def test_beyond_the_longest_trial_nothing_is_claimed():
    with pytest.raises(StatisticsError, match="at most 5 s"):
        restricted_mean([5.0, 3.0], [True, False], until=6.0)


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
