"""Designs of a comparison: how many pairs there are, after which one looks, what ends it, and what may be said then.

Nothing but the design decides on the primary comparison. Pairs are taken in the order in which they were scheduled;
what comes after the end belongs to the record, not to the decision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import StatisticsError, check_alpha
from evaweb.statistics.boundaries import MOST, SHAPES, Boundary, Look, boundary, in_pairs
from evaweb.statistics.difference import barnard
from evaweb.statistics.permutation import sign_flips
from evaweb.statistics.sequential import score_evidence, success_evidence

FIXED, ANYTIME = "none", "evidence"  # as plans have named them since there are plans
RULES = (FIXED, ANYTIME, *SHAPES)
SUCCESS, SCORE = "success", "score"
_TIE = 1e-9  # relative: a p that is alpha but for its last bits
Values = tuple[float, float]  # of the first and the second checkpoint in one block


@dataclass(frozen=True, slots=True)
class Design:
    """The design of a primary comparison, as it is frozen.

    `rule`: "none", a fixed number of pairs with one test at the end; "evidence", an e-process after every pair; "late"
    and "early", an exact `boundary` at its looks. Without a `margin` the question is whether the two differ; with one,
    whether the first's success rate is lower than the second's by less than that. `outcome` is "success" or "score".
    """

    rule: str
    pairs: int
    alpha: float
    margin: float | None = None
    outcome: str = SUCCESS
    boundary: Boundary | None = None


@dataclass(frozen=True, slots=True)
class Conclusion:
    """What a design says of the pairs there are, of those that are `foreseen`.

    `at` is the number of pairs after which it ended, None while it goes on, and `winner` the checkpoint ("first" or
    "second") that a boundary was crossed for. `p` is that of the one test of a fixed number, None with any other rule.
    """

    pairs: int
    at: int | None
    winner: str | None
    p: float | None
    foreseen: int

    @property
    def ended(self) -> str:
        """Empty while it goes on, "full" where all pairs are made, whatever is found then, "boundary" before that."""
        return "" if self.at is None else "full" if self.at == self.foreseen else "boundary"


def design(
    *,
    rule: str,
    pairs: int,
    alpha: float,
    margin: float | None = None,
    outcome: str = SUCCESS,
    looks: Sequence[int] = (),
) -> Design:
    """A design with its boundary, which is computed now; `looks` are pairs, none: after every one.

    StatisticsError names what cannot be: a margin or looks with a rule that has none, a boundary of over 250 pairs.
    """
    check_alpha(alpha)
    if rule not in RULES:
        raise StatisticsError(f"design = {rule!r}; allowed: {', '.join(RULES)}")
    if outcome not in (SUCCESS, SCORE):
        raise StatisticsError(f"outcome = {outcome!r}; allowed: {SUCCESS}, {SCORE}")
    if pairs < 1:
        raise StatisticsError(f"{pairs} pairs; allowed: 1 or more")
    if looks and rule not in SHAPES:
        raise StatisticsError(
            f"looks = {list(looks)} with the design {rule!r}; allowed with: {', '.join(SHAPES)}"
        )
    if looks and not 1 <= min(looks) <= max(looks) <= pairs:
        raise StatisticsError(f"looks = {list(looks)}; allowed: from 1 to {pairs}, the number of pairs")
    exact = rule in SHAPES or (rule == FIXED and margin is not None)
    if outcome == SCORE and exact:
        raise StatisticsError(f"outcome = {SCORE!r} with a boundary of successes; allowed: {SUCCESS}")
    if margin is not None and not exact:
        raise StatisticsError(
            f"margin = {margin:g} with the design {rule!r}; allowed with: none, {', '.join(SHAPES)}"
        )
    if not exact:
        return Design(rule, pairs, alpha, None, outcome)
    if pairs > MOST:
        raise StatisticsError(f"{pairs} pairs of a design with an exact boundary; allowed: 1 to {MOST}")
    at = [pairs] if rule == FIXED else list(looks) or None
    shape = rule if rule in SHAPES else "late"  # of one look there is no shape
    return Design(
        rule,
        pairs,
        alpha,
        margin,
        outcome,
        boundary(in_pairs(pairs, at), alpha=alpha, shape=shape, margin=margin),
    )


def conclude(found: Design, values: Sequence[Values]) -> Conclusion:
    """What `found` says of the pairs that are made, in the order of the schedule, the first one that is not made
    ending the list. More of them than the design foresees are not looked at.
    """
    given = values[: found.pairs]
    full = len(given) if len(given) == found.pairs else None
    if found.boundary is not None:
        at, winner = _crossed(found.boundary, given)
        return Conclusion(len(given), at or full, winner, None, found.pairs)
    if found.rule == ANYTIME:
        of = score_evidence if found.outcome == SCORE else _of_successes
        evidence = of(given, found.alpha)
        return Conclusion(len(given), evidence.stop or full, evidence.winner, None, found.pairs)
    if full is None:
        return Conclusion(len(given), None, None, None, found.pairs)
    p, lead = _scored(given) if found.outcome == SCORE else _succeeded(given)
    return Conclusion(full, full, _ahead(lead, 0) if p <= found.alpha * (1 + _TIE) else None, p, found.pairs)


def _succeeded(values: Sequence[Values]) -> tuple[float, float]:
    """Probability of the one test of a fixed number of pairs, and by how much the first is ahead."""
    first, second = _successes(values)
    return barnard(first, len(values), second, len(values)).p, first - second


def _scored(values: Sequence[Values]) -> tuple[float, float]:
    flips = sign_flips([one - other for one, other in values])
    return flips.p, flips.value


def _of_successes(values: Sequence[Values], alpha: float):  # type: ignore[no-untyped-def]
    return success_evidence([(bool(one), bool(other)) for one, other in values], alpha)


def _crossed(found: Boundary, values: Sequence[Values]) -> tuple[int | None, str | None]:
    """The pair after which a boundary was crossed, and for which checkpoint."""
    for number, look in enumerate(found.looks):
        if look.first > len(values):
            break
        first, second = _successes(values[: look.first])
        # With a margin a boundary asks about its second arm: the plan's first checkpoint.
        winner = found.winner(number, *((first, second) if found.margin is None else (second, first)))
        if winner:
            return look.first, winner if found.margin is None else "first"
    return None, None


def _successes(values: Sequence[Values]) -> tuple[int, int]:
    return sum(bool(one) for one, _ in values), sum(bool(other) for _, other in values)


def _ahead(first: float, second: float) -> str:
    return "first" if first > second else "second"


def table(found: Boundary) -> list[list[int]]:
    """The boundary in plain JSON: per look the trials of each arm, then the least extreme table that stops, if any."""
    return [[look.first, look.second, *(look.least or ())] for look in found.looks]


def of_table(rows: Sequence[Sequence[int]], alpha: float, margin: float | None) -> Boundary:
    """The boundary that `table` was made of."""
    looks = (Look(n, m, (least[0], least[1]) if least else None) for n, m, *least in rows)
    return Boundary(tuple(looks), alpha, margin)
