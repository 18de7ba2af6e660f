import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.sequential import score_evidence, success_evidence

PAIRS = st.lists(st.tuples(st.booleans(), st.booleans()), max_size=60)


def test_before_the_first_pair_nothing_is_known():
    found = success_evidence([])
    assert (found.pairs, found.stop, found.winner, found.p) == (0, None, None, 1.0)


def test_the_first_pairs_by_hand():
    # Predicted before: the bet on "second" has 1/3 for the first and 2/3 for the second, 1/2 under equality.
    found = success_evidence([(False, True), (False, True)])
    assert found.second[0] == pytest.approx(2 * math.log(2 / 3) - 2 * math.log(1 / 2))
    step = math.log(3 / 4) + math.log(3 / 4) - 2 * math.log(1 / 2)  # predicted 1/4 and 3/4 now
    assert found.second[1] - found.second[0] == pytest.approx(step)
    assert found.first[0] == pytest.approx(2 * math.log(1 / 3) - 2 * math.log(1 / 2))


def test_a_clear_difference_stops_and_says_who_is_better():
    found = success_evidence([(True, False)] * 12)
    assert found.winner == "first"
    assert found.stop is not None
    assert found.stop <= 8
    assert found.p_first[found.stop - 1] <= 0.025 < found.p_first[found.stop - 2]


@given(PAIRS)
def test_mirrored_pairs_are_mirrored_evidence(pairs):
    there = success_evidence(pairs)
    back = success_evidence([(other, one) for one, other in pairs])
    assert there.first == pytest.approx(back.second, abs=1e-12)
    assert there.p_first == pytest.approx(back.p_second, abs=1e-12)


@given(PAIRS)
def test_anytime_probabilities_never_rise(pairs):
    found = success_evidence(pairs)
    for path in (found.p_first, found.p_second):
        assert all(0 < after <= before <= 1 for before, after in zip((1.0, *path), path, strict=False))


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.9])
def test_each_bet_is_fair_whatever_the_common_rate(rate):
    """The expected factor of the next pair is at most 1 after any history: all of them, three pairs deep."""
    for history in range(4**3):
        pairs = [(bool(history >> (2 * i) & 1), bool(history >> (2 * i + 1) & 1)) for i in range(3)]
        before = success_evidence(pairs)
        for side in ("first", "second"):
            expected = sum(
                (rate if one else 1 - rate)
                * (rate if other else 1 - rate)
                * math.exp(
                    getattr(success_evidence([*pairs, (one, other)]), side)[-1] - getattr(before, side)[-1]
                )
                for one in (True, False)
                for other in (True, False)
            )
            assert expected <= 1 + 1e-12


@pytest.mark.parametrize("rate", [0.3, 0.5, 0.8])
def test_equal_arms_are_rarely_told_apart_however_often_one_looks(rate):
    random = np.random.default_rng(5)
    stopped = sum(
        success_evidence(map(tuple, random.random((150, 2)) < rate)).stop is not None for _ in range(400)
    )
    assert stopped / 400 <= 0.05


def test_partial_credit_finds_what_is_there_and_seldom_what_is_not():
    random = np.random.default_rng(6)
    equal = sum(score_evidence(random.beta(2, 2, (100, 2)).tolist()).stop is not None for _ in range(300))
    assert equal / 300 <= 0.05
    better = sum(
        score_evidence(np.column_stack([random.beta(5, 2, 100), random.beta(2, 3, 100)]).tolist()).winner
        == "first"
        for _ in range(100)
    )
    assert better >= 95


def two_points(low, high):
    """The fair chance of `high`, and both differences of scores as pairs of scores."""
    chance = -low / (high - low)
    return [(chance, (high, 0.0)), (1 - chance, (0.0, -low))]


@given(
    st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), max_size=30),
    st.floats(-1, -0.01),
    st.floats(0.01, 1),
)
def test_the_worth_of_partial_credit_is_a_martingale(history, low, high):
    """Whatever came before: where the mean difference is 0 the expected worth after the next pair is that before."""
    before = score_evidence(history)
    for side in ("first", "second"):
        worth = math.exp(getattr(before, side)[-1]) if history else 1.0
        expected = sum(
            chance * math.exp(getattr(score_evidence([*history, pair]), side)[-1])
            for chance, pair in two_points(low, high)
        )
        assert expected == pytest.approx(worth)


@pytest.mark.some(2)
@pytest.mark.parametrize("rare", [0.02, 0.1, 0.5, 0.9, 0.98])
def test_lopsided_differences_with_a_mean_of_zero_seldom_suffice(rare):
    """Each pair differs by much with a chance of `rare`, by little the other way else."""
    random = np.random.default_rng(7)
    much, little = 1 - rare, rare
    drawn = np.where(random.random((400, 100)) < rare, much, -little)
    pairs = [[(max(d, 0.0), max(-d, 0.0)) for d in run] for run in drawn.tolist()]
    assert sum(score_evidence(run).stop is not None for run in pairs) / 400 <= 0.05


def test_partial_credit_that_differs_little_is_bet_on_with_high_stakes():
    """50 pairs of Beta(5, 2) against Beta(4, 3), means .71 and .57: of 1,000 simulated .62 suffice, .16 with stakes
    of at most half."""
    random = np.random.default_rng(8)
    runs = np.stack([random.beta(5, 2, (300, 50)), random.beta(4, 3, (300, 50))], axis=-1)
    assert sum(score_evidence(run).winner == "first" for run in runs.tolist()) / 300 >= 0.5


def test_a_score_beyond_its_range_is_refused():
    with pytest.raises(StatisticsError, match=r"score = 1\.2"):
        score_evidence([(1.2, 0.0)])
    with pytest.raises(StatisticsError, match="alpha = 0"):
        success_evidence([], alpha=0)
