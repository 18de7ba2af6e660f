import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.results.reports.recompute import judged
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.calibration import calibration

TENTHS = st.integers(0, 10).map(lambda k: k / 10)
GIVEN = st.lists(st.tuples(TENTHS | st.floats(0, 1), st.booleans()), min_size=1, max_size=60)


def test_the_value_of_scikit_learns_documentation():
    # sklearn.metrics.brier_score_loss: y_true = [0, 1, 1, 0], y_prob = [0.1, 0.9, 0.8, 0.3]
    found = calibration([(0.1, False), (0.9, True), (0.8, True), (0.3, False)])
    assert found.brier == pytest.approx(0.0375)
    assert [(held.low, held.n, held.true) for held in found.bins] == [
        (0.1, 1, 0),
        (0.3, 1, 0),
        (0.8, 1, 1),
        (0.9, 1, 1),
    ]
    assert found.error == pytest.approx((0.1 + 0.3 + 0.2 + 0.1) / 4)


@given(st.floats(0, 1), st.integers(0, 30), st.integers(0, 30))
def test_one_probability_for_all_is_off_by_its_distance_from_the_share(probability, yes, no):
    if yes + no:
        found = calibration([(probability, True)] * yes + [(probability, False)] * no)
        share = yes / (yes + no)
        assert found.error == pytest.approx(abs(probability - share), abs=1e-9)
        assert found.brier == pytest.approx((probability - share) ** 2 + share * (1 - share), abs=1e-9)


@given(GIVEN)
def test_every_probability_is_in_one_bin_and_the_reports_program_has_the_same(pairs):
    found, again = calibration(pairs), judged.calibration(pairs)
    assert sum(held.n for held in found.bins) == found.n == again["n"] == len(pairs)
    assert all(held.low - 1e-9 <= held.probability <= held.high + 1e-9 for held in found.bins)
    assert (again["brier"], again["error"]) == pytest.approx((found.brier, found.error), abs=1e-9)
    assert [(held["low"], held["n"], held["true"]) for held in again["bins"]] == [
        (held.low, held.n, held.true) for held in found.bins
    ]


def test_what_is_no_probability_or_nothing_is_refused():
    with pytest.raises(StatisticsError, match="no probability"):
        calibration([])
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(StatisticsError, match="probability"):
            calibration([(wrong, True)])
