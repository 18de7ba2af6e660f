"""Simulated evaluations beside real ones: orders, violations, and what simulation adds to an interval."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import spearmanr

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.simulated_real import Powered, powered_difference, rank_correlation, rank_violation


def test_ranks_correlate_as_scipy_says_ties_included():
    chance = np.random.default_rng(5)
    for _ in range(20):
        simulated, real = (np.round(chance.random(7), 1).tolist() for _ in range(2))
        assert rank_correlation(simulated, real) == pytest.approx(spearmanr(simulated, real).statistic)
    assert rank_correlation([0.5, 0.5], [0.1, 0.9]) is None
    assert rank_correlation([0.5], [0.1]) is None
    with pytest.raises(StatisticsError, match="2 simulated rates and 1 real ones"):
        rank_correlation([0.1, 0.2], [0.3])


def test_a_violation_is_the_real_difference_that_simulation_turns_round():
    assert rank_violation([0.1, 0.5, 0.9], [0.2, 0.3, 0.7]) == 0.0
    # The first two are the other way round, .1 apart; the third is as it is.
    assert rank_violation([0.5, 0.1, 0.9], [0.2, 0.3, 0.7]) == pytest.approx((0.1 + 0.1 + 0.0) / 3)
    assert rank_violation([0.9, 0.5, 0.1], [0.2, 0.3, 0.7]) == pytest.approx((0.5 + 0.4 + 0.5) / 3)


def drawn(chance, real, agrees, n=30, more=600):
    """An arm: real outcomes, simulated ones that agree with them so often, and more simulated ones."""
    outcomes = chance.random(n) < real
    matched = np.where(chance.random(n) < agrees, outcomes, ~outcomes)
    share = real * agrees + (1 - real) * (1 - agrees)
    beside = chance.random(more) < share
    return Powered(
        list(zip(outcomes.astype(float), matched.astype(float), strict=True)), beside.astype(float)
    )


@pytest.mark.parametrize("agrees", [0.5, 0.8, 0.95])
def test_its_interval_holds_and_is_the_narrower_the_better_simulation_is(agrees):
    chance, held, widths, plain = np.random.default_rng(11), 0, [], []
    for _ in range(300):
        arms = drawn(chance, 0.7, agrees), drawn(chance, 0.4, agrees)
        found = powered_difference(*arms)
        alone = powered_difference(*(Powered(arm.paired, ()) for arm in arms))
        if found is None:  # too few failures of one
            continue
        held += found.interval.low <= 0.3 <= found.interval.high
        widths.append(found.interval.high - found.interval.low)
        plain.append(alone.interval.high - alone.interval.low)
    assert len(widths) > 250
    assert held / len(widths) > 0.95 - 4 * (0.05 * 0.95 / len(widths)) ** 0.5
    ratio = float(np.mean(widths) / np.mean(plain))
    assert ratio < {0.5: 1.01, 0.8: 0.9, 0.95: 0.65}[agrees]


def test_of_few_pairs_there_is_none():
    few = Powered([(1.0, 1.0)] * 7, [1.0] * 50)
    assert powered_difference(few, Powered([(1.0, 0.0), (0.0, 1.0)] * 8, [1.0, 0.0])) is None


def test_where_nearly_all_succeed_there_is_none():
    """Its interval would hold in 54 to 81 of 100."""
    rare = Powered([(1.0, 1.0)] * 16 + [(0.0, 1.0)] * 4, [1.0] * 50)
    enough = Powered([(1.0, 1.0)] * 5 + [(0.0, 1.0)] * 5, [1.0, 0.0] * 25)
    assert powered_difference(rare, enough) is None
    assert powered_difference(enough, enough) is not None
