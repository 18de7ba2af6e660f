"""Comparison of two arms over strata, so that a different share of easy scenes in one arm has no influence.

Formulae: Cochran (1954), Mantel and Haenszel (1959) without continuity correction; exact tests conditional on the
margins of each stratum, of a common odds ratio of 1 (Gart 1970) and of equal odds ratios (Zelen 1971).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from evaweb.statistics.base import StatisticsError, check_counts

_MOST = 20_000  # greatest number of combinations of tables to enumerate


@dataclass(frozen=True, slots=True)
class StratumTable:
    """Successes and trials of both arms in one stratum."""

    x1: int
    n1: int
    x2: int
    n2: int

    def __post_init__(self) -> None:
        check_counts(self.x1, self.n1)
        check_counts(self.x2, self.n2)

    @property
    def is_informative(self) -> bool:
        """Whether the stratum is informative: its margins allow more than one table."""
        return self.n1 > 0 and self.n2 > 0 and 0 < self.x1 + self.x2 < self.n1 + self.n2

    @property
    def ways(self) -> dict[int, int]:
        """Number of combinations by the first arm's number of successes, for each number that the margins allow."""
        successes = self.x1 + self.x2
        lowest, highest = max(0, successes - self.n2), min(self.n1, successes)
        return {
            x: math.comb(self.n1, x) * math.comb(self.n2, successes - x) for x in range(lowest, highest + 1)
        }


@dataclass(frozen=True, slots=True)
class Stratified:
    """Comparison over scenes.

    `odds_ratio` is that of Mantel and Haenszel (None if unbounded, or if no scene is informative) and `p` the
    probability of their test. `crude` is the difference of the pooled rates, `stratified` the weighted mean of the
    scenes' differences. `reversed` is True if both have opposite signs (Simpson's paradox): the pooled rates must not
    be quoted then.
    """

    odds_ratio: float | None
    p: float
    crude: float
    stratified: float
    reversed: bool


def mantel_haenszel(tables: Sequence[StratumTable]) -> Stratified:
    """Return the comparison of both arms over the scenes in which both were tried."""
    if not tables:
        raise StatisticsError("no scene in which both arms were tried")
    surplus = variance = above = below = weighted = weights = 0.0
    for t in tables:
        n, successes = t.n1 + t.n2, t.x1 + t.x2
        surplus += t.x1 - t.n1 * successes / n
        variance += t.n1 * t.n2 * successes * (n - successes) / (n * n * (n - 1))
        above += t.x1 * (t.n2 - t.x2) / n
        below += (t.n1 - t.x1) * t.x2 / n
        weight = t.n1 * t.n2 / n
        weighted += weight * (t.x1 / t.n1 - t.x2 / t.n2)
        weights += weight
    if variance > 0:
        from scipy.special import chdtrc

        p = float(chdtrc(1, surplus * surplus / variance))
    else:
        p = 1.0
    ratio = above / below if below > 0 else None
    crude = sum(t.x1 for t in tables) / sum(t.n1 for t in tables) - sum(t.x2 for t in tables) / sum(
        t.n2 for t in tables
    )
    stratified = weighted / weights
    # Equal rates that differ in the last bit only are not a paradox.
    return Stratified(
        ratio, p, crude, stratified, crude * stratified < 0 and min(abs(crude), abs(stratified)) > 1e-12
    )


def exact_within(tables: Sequence[StratumTable], least: int = 2) -> float | None:
    """Return the two-sided p-value of the exact test that both arms are equal within every stratum.

    The p-value is the probability of all totals of the first arm that are at most as probable as the observed total.
    Return None if fewer than `least` strata are informative.
    """
    telling = [table for table in tables if table.is_informative]
    if len(telling) < least:
        return None
    total = {0: 1}
    for table in telling:
        grown: dict[int, int] = {}
        for before, number in total.items():
            for x, more in table.ways.items():
                grown[before + x] = grown.get(before + x, 0) + number * more
        total = grown
    observed = total[sum(table.x1 for table in telling)]
    return sum(number for number in total.values() if number <= observed) / sum(total.values())


def interaction(tables: Sequence[StratumTable]) -> float | None:
    """Return the p-value of Zelen's exact test of whether the odds ratio is the same in all strata.

    It is the probability, if the odds ratios are equal, of tables that are at least as improbable as the observed ones.
    The result is None if fewer than two strata are informative, or if there are too many combinations to enumerate.
    """
    telling = sorted((table for table in tables if table.is_informative), key=lambda table: len(table.ways))
    if len(telling) < 2 or math.prod(len(table.ways) for table in telling[:-1]) > _MOST:
        return None
    observed = math.prod(table.ways[table.x1] for table in telling)
    as_improbable = whole = 0
    for number in _fillings([table.ways for table in telling], sum(table.x1 for table in telling)):
        whole += number
        as_improbable += number if number <= observed else 0
    return as_improbable / whole


def _fillings(tables: Sequence[dict[int, int]], left: int) -> Iterator[int]:
    """Yield the number of combinations of each way to distribute `left` successes of the first arm over the strata.

    `tables` has for each stratum the number of combinations by the first arm's number of successes.
    """
    first, *further = tables
    if not further:
        if left in first:
            yield first[left]
        return
    for x, number in first.items():
        for more in _fillings(further, left - x):
            yield number * more
