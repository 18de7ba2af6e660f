import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.confidence_sequence import confidence_sequence
from evaweb.statistics.sequential import score_evidence

DIFFERENCES = st.lists(st.floats(-1, 1), max_size=40)


def test_before_the_first_pair_nothing_is_known():
    found = confidence_sequence([])
    assert (found.low, found.high, found.level) == (-1.0, 1.0, 0.95)


def test_the_first_pair_by_hand():
    # The first ahead by all there is: a gambler with stake s against m has 1 - s + 2 s / (1 + m), half of all on
    # average, and at alpha 1/2 the wanted worth is 4; the others' worth never rises above 1.
    found = confidence_sequence([1.0], alpha=0.5)
    assert 0.5 + 0.5 * 2 / (1 + found.low) == pytest.approx(4.0)
    assert found.high == 1.0


@given(DIFFERENCES)
def test_arms_that_change_places_mirror_it(differences):
    there, back = (confidence_sequence([sign * d for d in differences]) for sign in (1, -1))
    assert (there is None) == (back is None)
    if there and back:
        assert (there.low, there.high) == pytest.approx((-back.high, -back.low), abs=1e-9)


@given(DIFFERENCES.filter(bool))
def test_each_pair_leaves_it_within_what_it_was(differences):
    before, after = confidence_sequence(differences[:-1]), confidence_sequence(differences)
    if after is None:
        return
    assert before is not None
    assert -1 <= before.low <= after.low + 1e-9
    assert after.high - 1e-9 <= before.high <= 1


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), max_size=40), st.sampled_from([0.05, 0.4]))
def test_it_leaves_out_no_difference_where_the_evidence_suffices(pairs, alpha):
    """The bet on scores is the one against a mean difference of 0, among all that it is made of."""
    evidence = score_evidence(pairs, alpha)
    found = confidence_sequence([one - other for one, other in pairs], alpha)
    reached = max((*evidence.first, *evidence.second), default=0.0)
    if abs(reached - math.log(2 / alpha)) > 1e-6:
        assert (evidence.stop is None) == (found is not None and found.low <= 0 <= found.high)


@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.5])
def test_over_all_orders_of_outcomes_the_truth_is_left_out_at_most_at_alpha(alpha):
    """Every course of six pairs, looked at after each: what is left out once stays out."""
    courses = list(itertools.product((-1, 0, 1), repeat=6))
    intervals = [confidence_sequence(course, alpha) for course in courses]
    for ahead, behind in itertools.product(np.linspace(0, 1, 9), repeat=2):
        if ahead + behind <= 1:
            chance = {1: ahead, 0: 1 - ahead - behind, -1: behind}
            truth = float(ahead - behind)
            missed = math.fsum(
                math.prod(chance[d] for d in course)
                for course, found in zip(courses, intervals, strict=True)
                if found is None or not found.low - 1e-9 <= truth <= found.high + 1e-9
            )
            assert missed <= alpha


@pytest.mark.some(1)
@pytest.mark.parametrize(("rare", "much", "little"), [(0.02, 1.0, -0.1), (0.1, 1.0, -1.0), (0.9, 0.3, -0.5)])
def test_lopsided_differences_keep_their_mean_in_it(rare, much, little):
    random = np.random.default_rng(3)
    truth = rare * much + (1 - rare) * little
    runs = np.where(random.random((300, 100)) < rare, much, little).tolist()
    held = [found is not None and found.holds(truth) for found in map(confidence_sequence, runs)]
    assert sum(held) / 300 >= 0.95


def test_it_narrows_around_what_was_observed():
    random = np.random.default_rng(4)
    one, other = random.random((2, 400)) < [[0.8], [0.5]]
    found = [confidence_sequence((one * 1.0 - other)[:n].tolist()) for n in (10, 50, 100, 400)]
    widths = [interval.high - interval.low for interval in found]
    assert widths == sorted(widths, reverse=True)
    assert widths[-1] < 0.35
    assert all(interval.holds(0.3) for interval in found)


def test_pairs_that_contradict_every_one_difference_leave_none():
    assert confidence_sequence([1.0] * 30 + [-1.0] * 60) is None


def test_what_cannot_be_is_named():
    with pytest.raises(StatisticsError, match=r"a difference of 1\.5; allowed: -1 to 1"):
        confidence_sequence([0.2, 1.5])
    with pytest.raises(StatisticsError, match="a difference of nan"):
        confidence_sequence([math.nan])
    with pytest.raises(StatisticsError, match="alpha = 1"):
        confidence_sequence([], alpha=1)
