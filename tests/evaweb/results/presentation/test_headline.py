from evaweb.results.presentation.headline import _counts
from evaweb.statistics.designs import conclude, design, in_blocks

SCORES = in_blocks([(0.75, 0.5)] * 10)
SIDES = [0.75] * 10, [0.5] * 10


def test_a_fixed_number_of_scores_stands_with_the_p_of_its_permutation_test():
    found = design(rule="none", blocks=10, alpha=0.05, outcome="score")
    said = _counts(found, conclude(found, SCORES), *SIDES)
    assert said == "mean scores 0.75 and 0.50, p = 0.002, after 10 pairs"


def test_evidence_of_scores_has_no_p_of_a_fixed_number():
    found = design(rule="evidence", blocks=10, alpha=0.05, outcome="score")
    assert _counts(found, conclude(found, SCORES), *SIDES) == "mean scores 0.75 and 0.50 after 10 pairs"
