"""What the headline would be without a part of the trials."""

from itertools import combinations

from evaweb.results.presentation.alternatives import _of_these, _stepped
from evaweb.statistics.designs import design, evaluate_design, findings

SUCCESSES = (
    38,
    26,
    16,
)  # of 40; the second and third are told apart at the last step of Holm's procedure alone


def winners(found, blocks):
    return [one.winner for one in findings(found, blocks).each]


def test_what_is_left_of_several_comparisons_is_decided_by_the_steps_that_decided_all_of_it():
    pairs = tuple(combinations(range(3), 2))
    found = design(rule="none", blocks=40, alpha=0.05, comparisons=pairs, holm=True)
    blocks = [[(arm, float(at < won)) for arm, won in enumerate(SUCCESSES)] for at in range(40)]
    assert winners(found, blocks) == ["first", "first", "first"]
    left = [at for at in range(40) if at != 39]
    alone = [_of_these(found, pair, left, blocks) for pair in pairs]
    assert evaluate_design(*alone[2], alone[2][0].comparisons[0]).winner is None  # at its share of alpha
    stepped = _stepped(found, alone)
    assert [evaluate_design(by, both, by.comparisons[0]).winner for by, both in stepped] == ["first"] * 3


def test_a_comparison_of_which_nothing_is_left_counts_as_one_all_the_same():
    pairs = ((0, 1), (0, 2))
    found = design(rule="none", blocks=40, alpha=0.05, comparisons=pairs, holm=True)
    blocks = [[(arm, float(at < won)) for arm, won in enumerate(SUCCESSES)] for at in range(40)]
    alone = [_of_these(found, pairs[0], range(39), blocks), (found, [])]
    assert [by.alpha for by, _ in _stepped(found, alone)] == [0.025, 0.05]


def test_one_that_does_not_take_those_steps_keeps_its_share():
    found = design(rule="none", blocks=40, alpha=0.05, comparisons=((0, 1), (0, 2)))
    blocks = [[(arm, float(at < won)) for arm, won in enumerate(SUCCESSES)] for at in range(40)]
    alone = [_of_these(found, pair, range(39), blocks) for pair in found.comparisons]
    assert _stepped(found, alone) == alone
