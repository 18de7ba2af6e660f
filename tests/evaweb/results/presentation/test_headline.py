from itertools import combinations

import pytest

from evaweb.plans.models import Plan
from evaweb.results.presentation.headline import _counts, best_of
from evaweb.results.presentation.integrity import too_few_text
from evaweb.statistics.designs import design, evaluate_design, in_blocks

SCORES = in_blocks([(0.75, 0.5)] * 10)
SIDES = [0.75] * 10, [0.5] * 10


def test_a_fixed_number_of_scores_stands_with_the_p_of_its_permutation_test():
    found = design(rule="none", blocks=10, alpha=0.05, outcome="score")
    said = _counts(found, evaluate_design(found, SCORES), *SIDES)
    assert said == "mean scores 0.75 and 0.50, p = 0.002, after 10 pairs"


def test_evidence_of_scores_has_no_p_of_a_fixed_number():
    found = design(rule="evidence", blocks=10, alpha=0.05, outcome="score")
    assert (
        _counts(found, evaluate_design(found, SCORES), *SIDES) == "mean scores 0.75 and 0.50 after 10 pairs"
    )


def best(*successes, n=40, **changed):
    """What is said of checkpoints A, B, C ..., of whose `n` trials each the first so many succeeded."""
    names = "ABCDE"[: len(successes)]
    document = {"format": 6, "comparisons": [list(pair) for pair in combinations(names, 2)]} | changed
    pairs = tuple(combinations(range(len(names)), 2))
    found = design(rule="none", blocks=n, alpha=0.05, comparisons=pairs, holm=True)
    blocks = [[(arm, float(at < won)) for arm, won in enumerate(successes)] for at in range(n)]
    return best_of(Plan(document=document), found, blocks)


@pytest.mark.parametrize(
    ("successes", "said"),
    [
        ((38, 20, 5), "A is the best of 3"),
        ((20, 38, 5), "B is the best of 3"),
        ((38, 37, 5), "No single best of 3: A and B were not told apart (highest success rate: A)"),
        ((37, 37, 5), "No single best of 3: A and B were not told apart (highest success rate: A and B)"),
        (
            (20, 21, 22, 2),
            "No single best of 4: A, B and C were not told apart (highest success rate: C)",
        ),
        ((38, 5), ""),  # of two the comparison says it
    ],
)
def test_which_of_several_is_best_is_said_where_all_were_compared(successes, said):
    assert best(*successes) == said


def test_a_plan_of_before_it_was_said_keeps_its_words():
    assert best(38, 20, 5, format=5) == ""


@pytest.mark.parametrize(
    ("pairs", "said"), [(0, ""), (1, "1 pair is too few"), (5, "5 pairs are too few"), (6, "")]
)
def test_pairs_that_no_test_of_delays_could_tell_apart_are_said_to_be_too_few(pairs, said):
    test = {"pairs": pairs, "p": 1.0 if pairs else None}
    found = too_few_text({"delays": {"alpha": 0.05, "rows": [{"tests": [test]}]}})
    assert found.startswith(said)
    assert bool(found) == bool(said)
