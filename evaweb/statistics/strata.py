"""Two arms compared over strata, so that an easy scene tried more often by one arm decides nothing.

Formulae: Cochran (1954), Mantel and Haenszel (1959) without continuity correction; exact tests conditional on the
margins of each stratum, of a common odds ratio of 1 (Gart 1970) and of equal odds ratios (Zelen 1971).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from evaweb.statistics.base import StatisticsError, check_counts

_MOST = 20_000  # ways to fill the tables that are looked at one by one


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
    def tells(self) -> bool:
        """False where its margins leave one table only."""
        return self.n1 > 0 and self.n2 > 0 and 0 < self.x1 + self.x2 < self.n1 + self.n2

    @property
    def ways(self) -> dict[int, int]:
        """In how many ways each number of the first's successes can come about with these margins."""
        successes = self.x1 + self.x2
        lowest, highest = max(0, successes - self.n2), min(self.n1, successes)
        return {
            x: math.comb(self.n1, x) * math.comb(self.n2, successes - x) for x in range(lowest, highest + 1)
        }


@dataclass(frozen=True, slots=True)
class Stratified:
    """The comparison over scenes.

    `odds_ratio` is Mantel and Haenszel's (None where it has no bound, or no scene tells), `p` of their test, `crude`
    the difference of the pooled rates, `stratified` that of the scenes' rates, weighted by what each scene tells.
    `reversed` where both have opposite signs: Simpson's paradox, the pooled rates must not be quoted.
    """

    odds_ratio: float | None
    p: float
    crude: float
    stratified: float
    reversed: bool


def mantel_haenszel(tables: Sequence[StratumTable]) -> Stratified:
    """Both arms over the scenes in which both were tried."""
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
    # Beyond rounding: equal rates that differ in the last bit are no paradox.
    return Stratified(
        ratio, p, crude, stratified, crude * stratified < 0 and min(abs(crude), abs(stratified)) > 1e-12
    )


def exact_within(tables: Sequence[StratumTable], least: int = 2) -> float | None:
    """Two-sided probability, within strata, of the first's successes or any as improbable, were both arms equal in
    each; None where fewer than `least` strata tell anything.
    """
    telling = [table for table in tables if table.tells]
    if len(telling) < least:
        return None
    total = {0: 1}
    for table in telling:
        grown: dict[int, int] = {}
        for before, ways in total.items():
            for x, more in table.ways.items():
                grown[before + x] = grown.get(before + x, 0) + ways * more
        total = grown
    seen = total[sum(table.x1 for table in telling)]
    return sum(ways for ways in total.values() if ways <= seen) / sum(total.values())


def interaction(tables: Sequence[StratumTable]) -> float | None:
    """Probability of these tables or any as improbable, were the odds ratio the same in all strata; None where fewer
    than two tell anything, or there are too many ways to count.
    """
    telling = sorted((table for table in tables if table.tells), key=lambda table: len(table.ways))
    if len(telling) < 2 or math.prod(len(table.ways) for table in telling[:-1]) > _MOST:
        return None
    seen = math.prod(table.ways[table.x1] for table in telling)
    as_improbable = whole = 0
    for ways in _fillings([table.ways for table in telling], sum(table.x1 for table in telling)):
        whole += ways
        as_improbable += ways if ways <= seen else 0
    return as_improbable / whole


def _fillings(tables: Sequence[dict[int, int]], left: int) -> Iterator[int]:
    """The ways of each filling whose successes of the first add up to `left`."""
    first, *rest = tables
    if not rest:
        if left in first:
            yield first[left]
        return
    for x, ways in first.items():
        for more in _fillings(rest, left - x):
            yield ways * more
