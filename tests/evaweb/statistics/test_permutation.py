from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.results.reports.recompute.methods import sign_flips as offline
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.permutation import sign_flip_test


def enumerated(hundredths):
    """Of all ways in which the signs may fall, the share whose sum is as far from 0."""
    sums = [abs(sum(s * d for s, d in zip(signs, hundredths, strict=True)))
            for signs in product((1, -1), repeat=len(hundredths))]  # fmt: skip
    return sum(found >= abs(sum(hundredths)) for found in sums) / len(sums)


@given(st.lists(st.integers(-100, 100), min_size=1, max_size=9))
def test_every_way_in_which_the_signs_may_fall_counts_once(hundredths):
    differences = [d / 100 for d in hundredths]
    assert sign_flip_test(differences).p == pytest.approx(enumerated(hundredths))
    assert offline(differences) == pytest.approx(enumerated(hundredths))


def test_fishers_sign_test_is_a_case_of_it():
    assert sign_flip_test([1.0] * 8 + [-1.0] * 2).p == pytest.approx(0.109375)  # exact McNemar of 8 against 2
    assert sign_flip_test([0.0] * 5).p == 1.0
    assert sign_flip_test([1 / 3, 1 / 3, 1 / 3, -1.0]).p == 1.0  # thirds are no rounding


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=30))
def test_a_mirror_says_the_same(differences):
    here, there = sign_flip_test(differences), sign_flip_test([-d for d in differences])
    assert (here.pairs, here.p) == (there.pairs, there.p)
    assert 0 < here.p <= 1


@pytest.mark.parametrize(("n", "scale"), [(40, 1.0), (120, 37.5), (400, 1.0)])
def test_many_differences_of_any_size_are_counted_the_same_by_both(n, scale):
    differences = (np.random.default_rng(n).normal(0.03, 0.3, n).clip(-1, 1) * scale).tolist()
    found = sign_flip_test(differences, scale).p
    assert found == pytest.approx(offline(differences, scale), rel=1e-9)
    turned = np.random.default_rng(1).choice([1, -1], (20_000, n)) @ np.array(differences)
    assert found == pytest.approx((abs(turned) >= abs(sum(differences))).mean(), abs=0.02)


def test_equal_arms_are_told_apart_at_most_as_often_as_alpha():
    random = np.random.default_rng(2)
    for levels in ([0, 1], [0, 0.5, 1], [0, 0.1, 0.9, 1]):
        pairs = random.choice(levels, (600, 12, 2))
        wrong = sum(sign_flip_test((one[:, 0] - one[:, 1]).tolist()).p <= 0.05 for one in pairs)
        assert wrong <= 600 * 0.05 + 3 * (600 * 0.05 * 0.95) ** 0.5


def test_differences_that_cannot_be_are_refused():
    with pytest.raises(StatisticsError, match="no pair"):
        sign_flip_test([])
    with pytest.raises(StatisticsError, match=r"a difference of 1\.5; allowed: -1 to 1"):
        sign_flip_test([0.2, 1.5])
    with pytest.raises(StatisticsError, match="a difference of nan"):
        sign_flip_test([float("nan")])
