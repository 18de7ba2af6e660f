import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.coverage import CASES, covered
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.bounded import bounded_mean
from evaweb.statistics.proportions import clopper_pearson


@pytest.mark.parametrize(("successes", "n"), [(0, 5), (3, 5), (5, 5), (1, 1), (46, 50)])
def test_outcomes_of_0_and_1_have_clopper_and_pearsons_ends(successes, n):
    found = bounded_mean({"all": [1.0] * successes + [0.0] * (n - successes)}, seed=1)
    exact = clopper_pearson(successes, n)
    assert found.value == pytest.approx(successes / n)
    assert (found.interval.low, found.interval.high) == pytest.approx((exact.low, exact.high), abs=0.015)


def test_scenes_are_equally_heavy_whatever_their_trials():
    found = bounded_mean({"easy": [1.0] * 30 + [0.0] * 10, "hard": [0.0, 0.0, 1.0, 0.0]}, seed=2)
    assert found.value == pytest.approx(0.5)
    assert found.interval.low < 0.5 < found.interval.high
    with pytest.raises(StatisticsError, match="'hard' has no trial"):
        bounded_mean({"easy": [1], "hard": []}, seed=2)
    with pytest.raises(StatisticsError, match="no trial"):
        bounded_mean({}, seed=2)
    with pytest.raises(StatisticsError, match=r"an outcome of 1\.2; allowed: 0 to 1"):
        bounded_mean({"easy": [1.2]}, seed=2)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=20))
def test_a_scale_changes_nothing_and_a_mirror_mirrors(outcomes):
    found = bounded_mean({"all": outcomes}, seed=3)
    wide = bounded_mean({"all": [60 * one - 20 for one in outcomes]}, seed=3, bounds=(-20.0, 40.0))
    assert (wide.interval.low + 20) / 60 == pytest.approx(found.interval.low, abs=0.02)
    turned = bounded_mean({"all": [1 - one for one in outcomes]}, seed=3)
    assert 1 - turned.interval.high == pytest.approx(found.interval.low, abs=0.04)
    assert 0 <= found.interval.low <= found.value + 1e-12
    assert found.value - 1e-12 <= found.interval.high <= 1


@pytest.mark.some(3)
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.wanted])
def test_the_fewest_trials_that_have_an_interval_are_covered(name):
    """A bootstrap covers 70 % at five trials of lopsided scores: of 300 runs at least 93 % here."""
    case = CASES[name]
    assert covered(case, case.fewest, runs=300, draws=400) >= 0.93
