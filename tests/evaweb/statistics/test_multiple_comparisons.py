from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.multiple_comparisons import holm, letters


def pairs(*names):
    return {frozenset(name) for name in names}


def test_holm_gives_the_published_values():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


def test_holm_refuses_what_is_no_probability():
    with pytest.raises(StatisticsError, match=r"p = 1\.5"):
        holm([0.1, 1.5])


@given(st.lists(st.floats(0, 1), max_size=12))
def test_a_corrected_probability_is_never_smaller_and_keeps_the_order(given_):
    found = holm(given_)
    assert all(after >= before - 1e-15 for before, after in zip(given_, found, strict=True))
    for i, j in combinations(range(len(given_)), 2):
        assert given_[i] >= given_[j] or found[i] <= found[j]


def test_letters_of_the_published_example():
    assert letters("ABCD", pairs("AC", "AD", "BD")) == {"A": "a", "B": "ab", "C": "bc", "D": "c"}
    assert letters("ABCD", set()) == dict.fromkeys("ABCD", "a")
    assert letters([], set()) == {}


@given(st.integers(1, 7).flatmap(lambda k: st.tuples(st.just(k), st.sets(st.integers(0, k * (k - 1) // 2)))))
def test_two_share_a_letter_if_and_only_if_they_are_not_separated(drawn):
    k, chosen = drawn
    names = "ABCDEFG"[:k]
    every = [frozenset(pair) for pair in combinations(names, 2)]
    separated = {pair for i, pair in enumerate(every) if i in chosen}
    found = letters(names, separated)
    for pair in every:
        one, other = pair
        assert bool(set(found[one]) & set(found[other])) == (pair not in separated)
    assert all(found.values())


def test_letters_refuse_names_they_do_not_know():
    with pytest.raises(StatisticsError, match="allowed: two of"):
        letters("AB", pairs("AC"))
    with pytest.raises(StatisticsError, match="stands twice"):
        letters("AA", set())
