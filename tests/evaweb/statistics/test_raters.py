import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.milestone_funnel import funnel
from evaweb.statistics.raters import cohen_kappa, gwet_ac1, krippendorff_alpha

RATED = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=1, max_size=40)


def table(both, first, second, neither):
    return [(1, 1)] * both + [(1, 0)] * first + [(0, 1)] * second + [(0, 0)] * neither


def test_the_published_values():
    assert cohen_kappa(table(20, 5, 10, 15)) == pytest.approx(0.4)
    assert cohen_kappa(table(118, 5, 2, 0)) == pytest.approx(-0.0234, abs=5e-5)
    assert gwet_ac1(table(118, 5, 2, 0)) == pytest.approx(0.9408, abs=5e-5)


def test_krippendorff_of_his_own_example():
    # Computing Krippendorff's alpha-reliability (2011), part C: four observers, values missing.
    a = [1, 2, 3, 3, 2, 1, 4, 1, 2, None, None, None]
    b = [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, None, 3]
    c = [None, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, None]
    d = [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, None]
    units = list(zip(a, b, c, d, strict=True))
    assert krippendorff_alpha(units) == pytest.approx(0.743, abs=5e-4)
    assert krippendorff_alpha(units, "interval") == pytest.approx(0.849, abs=5e-4)


@given(RATED)
def test_agreement_is_1(pairs):
    same = [*((one, one) for one, _ in pairs), (0, 0), (1, 1)]
    assert cohen_kappa(same) == gwet_ac1(same, 4) == 1.0
    assert krippendorff_alpha(same) == 1.0


@pytest.mark.parametrize("statistic", [cohen_kappa, krippendorff_alpha])
def test_ratings_that_all_say_the_same_word_tell_nothing_of_chance(statistic):
    with pytest.raises(StatisticsError, match="all ratings say 1: how often chance agrees is not defined"):
        statistic([(1, 1)] * 30)
    assert gwet_ac1([(1, 1)] * 30) == 1.0


def test_ratings_that_cannot_be_are_refused():
    with pytest.raises(StatisticsError, match="no trial"):
        cohen_kappa([])
    with pytest.raises(StatisticsError, match="rated by two people"):
        krippendorff_alpha([[1, None], [None, 2]])
    with pytest.raises(StatisticsError, match="3 categories were used, 2 are declared"):
        gwet_ac1([(0, 1), (2, 2)])


def test_a_funnel_counts_of_all_and_of_those_that_came_so_far():
    steps = funnel([[True, True, False], [True, False, False], [False, False, False], [True, True, True]])
    assert [(s.of_all.successes, s.of_all.n) for s in steps] == [(3, 4), (2, 4), (1, 4)]
    assert [(s.of_previous.successes, s.of_previous.n) for s in steps] == [(3, 4), (2, 3), (1, 2)]
    assert funnel([]) == []
    with pytest.raises(StatisticsError, match="the same number in each"):
        funnel([[True], [True, False]])
