"""Two arms compared over several scenes, so that an easy scene tried more often by one arm decides nothing.

Formulae: Cochran (1954), Mantel and Haenszel (1959) without continuity correction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import StatisticsError, check_counts


@dataclass(frozen=True, slots=True)
class Table:
    """Successes and trials of both arms in one scene."""

    x1: int
    n1: int
    x2: int
    n2: int

    def __post_init__(self) -> None:
        check_counts(self.x1, self.n1)
        check_counts(self.x2, self.n2)


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


def mantel_haenszel(tables: Sequence[Table]) -> Stratified:
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
