import math
from collections import defaultdict
from fractions import Fraction
from itertools import product
from math import comb

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import barnard_exact, hypergeom

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.difference import barnard, newcombe, probability_better
from evaweb.statistics.paired import mcnemar, over_conditions
from evaweb.statistics.proportions import posterior
from evaweb.statistics.stratified import (
    StratumTable,
    exact_within,
    interaction,
    mantel_haenszel,
)
from tests.examples import some

COUNTS = st.integers(1, 60).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@pytest.mark.parametrize(
    ("counts", "low", "high"),
    [((56, 70, 48, 80), 0.0524, 0.3339), ((9, 10, 3, 10), 0.1705, 0.8090), ((5, 56, 0, 29), -0.0381, 0.1926)],
)
def test_newcombe_gives_the_published_intervals(counts, low, high):
    found = newcombe(*counts)
    assert (found.interval.low, found.interval.high) == pytest.approx((low, high), abs=5e-5)


@given(COUNTS, COUNTS)
def test_the_difference_lies_in_its_interval_and_turns_with_the_arms(one, other):
    there, back = newcombe(*one, *other), newcombe(*other, *one)
    assert -1 <= there.interval.low <= there.value + 1e-12 <= there.interval.high + 2e-12 <= 1 + 2e-12
    assert (back.value, back.interval.low) == pytest.approx((-there.value, -there.interval.high), abs=1e-12)


def test_barnard_gives_the_published_value():
    found = barnard(43, 53, 40, 79)  # columns of [[43, 40], [10, 39]]
    assert found.statistic == pytest.approx(3.555406780, abs=1e-8)
    assert found.p == pytest.approx(0.000362832, abs=1e-8)


def test_barnard_is_scipys_where_no_other_table_is_as_extreme():
    for table in ((30, 40, 11, 40), (3, 17, 9, 23), (45, 50, 33, 52), (1, 29, 9, 31)):
        x1, n1, x2, n2 = table
        oracle = barnard_exact([[x1, x2], [n1 - x1, n2 - x2]], pooled=True)
        assert barnard(*table).p == pytest.approx(oracle.pvalue, abs=1e-7)
        assert barnard(*table).statistic == pytest.approx(oracle.statistic)


@given(st.integers(1, 25), st.integers(1, 25), st.data())
def test_barnard_is_the_largest_probability_of_all_tables_as_extreme(n1, n2, data):
    x1, x2 = data.draw(st.integers(0, n1)), data.draw(st.integers(0, n2))
    found = barnard(x1, n1, x2, n2)
    if x1 + x2 in (0, n1 + n2):
        assert found.p == 1.0
        return

    def z(a, b):
        m = Fraction(a + b, n1 + n2)
        return (Fraction(a, n1) - Fraction(b, n2)) ** 2 / (m * (1 - m)) if 0 < m < 1 else Fraction(0)

    extreme = [
        (a, b) for a in range(n1 + 1) for b in range(n2 + 1) if z(a, b) >= z(x1, x2)
    ]  # without rounding

    def total(p):
        return sum(
            comb(n1, a) * comb(n2, b) * p ** (a + b) * (1 - p) ** (n1 + n2 - a - b) for a, b in extreme
        )

    highest = max(total(i / 300) for i in range(1, 300))
    assert highest <= found.p + 1e-12
    assert found.p <= highest + 0.01


@pytest.mark.parametrize("counts", [(0, 5, 0, 7), (5, 5, 7, 7)])
def test_where_all_or_none_succeeded_barnard_finds_nothing(counts):
    assert barnard(*counts).p == 1.0


def test_barnard_refuses_counts_that_cannot_be():
    with pytest.raises(StatisticsError, match="6 successes in 5 trials"):
        barnard(6, 5, 0, 5)


@settings(max_examples=some(30))
@given(COUNTS, COUNTS)
def test_the_probability_to_be_better_is_that_of_the_posteriors(one, other):
    from scipy.integrate import quad
    from scipy.stats import beta

    a, b = posterior(*one), posterior(*other)
    expected, _ = quad(lambda t: beta.pdf(t, a.a, a.b) * beta.cdf(t, b.a, b.b), 0, 1, limit=200)
    assert probability_better(*one, *other) == pytest.approx(expected, abs=1e-6)


@given(COUNTS)
def test_an_arm_is_better_than_its_like_with_probability_one_half(one):
    assert probability_better(*one, *one) == pytest.approx(0.5, abs=1e-9)


def test_mcnemar_looks_at_discordant_pairs_alone():
    pairs = [(True, False)] * 8 + [(False, True)] * 2 + [(True, True)] * 30
    found = mcnemar(pairs)
    assert (found.first_only, found.second_only, found.pairs) == (8, 2, 40)
    assert found.p == pytest.approx(0.109375)
    assert mcnemar([(True, True)] * 5).p == 1.0


def test_the_interval_over_conditions_is_of_conditions_not_of_trials():
    first = {f"position {i}": [1.0] * 10 for i in range(4)} | {"position 4": [0.0] * 10}
    second = {f"position {i}": [0.0] * 10 for i in range(5)}
    found = over_conditions(first, second, seed=1)
    assert found.value == pytest.approx(0.8)
    # Five conditions, however many trials: differences of 0 and 1 only, on the scale from -1 to 1.
    fewer = over_conditions(
        {k: v[:1] for k, v in first.items()}, {k: v[:1] for k, v in second.items()}, seed=1
    )
    assert found == fewer
    assert found.interval.low < 0.2
    assert found.interval.high > 0.97


def test_two_conditions_that_say_the_same_are_little():
    found = over_conditions({"a": [1], "b": [1]}, {"a": [0], "b": [0]}, seed=0)
    assert (found.value, found.interval.high) == (1.0, 1.0)
    assert found.interval.low == pytest.approx(2 * 0.025**0.5 - 1, abs=0.03)  # Clopper and Pearson's 2 of 2


def test_conditions_that_were_not_shared_say_nothing():
    with pytest.raises(StatisticsError, match="at least 2 are needed"):
        over_conditions({"a": [1]}, {"a": [0]}, seed=0)
    with pytest.raises(StatisticsError, match="second arm has no trial at 'b'"):
        over_conditions({"a": [1], "b": [1]}, {"a": [0], "b": []}, seed=0)


def test_simpsons_paradox_is_seen():
    # Kidney stones (Charig et al. 1986): better in both strata, worse when pooled.
    found = mantel_haenszel([StratumTable(81, 87, 234, 270), StratumTable(192, 263, 55, 80)])
    assert found.crude == pytest.approx(273 / 350 - 289 / 350)
    assert found.stratified > 0
    assert found.reversed
    assert found.odds_ratio == pytest.approx(1.446847, abs=1e-5)


def test_one_stratum_is_a_plain_table():
    found = mantel_haenszel([StratumTable(9, 10, 3, 10)])
    assert found.odds_ratio == pytest.approx((9 * 7) / (1 * 3))
    assert found.crude == pytest.approx(found.stratified) == pytest.approx(0.6)
    assert not found.reversed
    # (n - 1) (ad - bc)^2 / (rows and columns): Mantel-Haenszel's statistic of one table.
    chi2 = 19 * (9 * 7 - 1 * 3) ** 2 / (10 * 10 * 12 * 8)
    assert found.p == pytest.approx(math.erfc(math.sqrt(chi2 / 2)), rel=1e-9)


def test_no_difference_anywhere_is_no_evidence():
    found = mantel_haenszel([StratumTable(5, 5, 7, 7)])
    assert (found.p, found.odds_ratio, found.reversed) == (1.0, None, False)


SIZES, WINS = st.integers(1, 5), st.integers(0, 5)
TABLES = st.lists(
    st.builds(lambda n1, n2, a, b: StratumTable(min(a, n1), n1, min(b, n2), n2), SIZES, SIZES, WINS, WINS),
    min_size=1,
    max_size=3,
)


def one_by_one(tables):
    """Every way to fill the tables with these margins: the first's successes in each, and its probability."""
    ways = [
        [(x, float(hypergeom.pmf(x, t.n1 + t.n2, t.x1 + t.x2, t.n1))) for x in range(t.n1 + 1)]
        for t in tables
    ]
    for chosen in product(*ways):
        yield [x for x, _ in chosen], math.prod(p for _, p in chosen)


@given(TABLES)
def test_exact_tests_over_strata_count_every_way_to_fill_the_tables(tables):
    telling = [t for t in tables if t.is_informative]
    if len(telling) < 2:
        assert (exact_within(tables), interaction(tables)) == (None, None)
        return
    seen = [t.x1 for t in telling]
    sums, whole = defaultdict(float), [(xs, p) for xs, p in one_by_one(telling) if p > 0]
    for xs, p in whole:
        sums[sum(xs)] += p
    expected = sum(p for p in sums.values() if p <= sums[sum(seen)] * (1 + 1e-9))
    assert exact_within(tables) == pytest.approx(expected)
    alike = [(xs, p) for xs, p in whole if sum(xs) == sum(seen)]
    own = next(p for xs, p in alike if xs == seen)
    expected = sum(p for _, p in alike if p <= own * (1 + 1e-9)) / sum(p for _, p in alike)
    assert interaction(tables) == pytest.approx(expected)


def test_a_confounded_difference_is_none_within_strata():
    """One checkpoint had the better operator more often; with each operator both are alike."""
    assert exact_within([StratumTable(18, 20, 4, 5), StratumTable(1, 5, 5, 20)]) > 0.5
    assert barnard(19, 25, 9, 25).p < 0.01


def test_an_interaction_is_found_where_the_difference_turns_and_not_where_it_is_the_same():
    assert interaction([StratumTable(18, 20, 4, 20), StratumTable(5, 20, 17, 20)]) < 1e-6
    assert interaction([StratumTable(18, 20, 4, 20), StratumTable(17, 20, 5, 20)]) > 0.5
    assert interaction([StratumTable(125, 250, 125, 250)] * 4) is None  # too many ways to count
