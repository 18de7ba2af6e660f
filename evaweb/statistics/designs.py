"""Designs of comparisons: number of blocks, interim looks, stopping rule, and conclusions.

Only the design decides planned comparisons. Blocks count in the order of the schedule; blocks after the end belong to
the record, not to the decision. A paired block has one trial of each arm; with two arms in random order, a block has
two trials of the arms that were drawn. Several comparisons share alpha equally (Bonferroni), or step by step if they
have one test at the end (Holm 1979).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from evaweb.statistics.base import StatisticsError, check_alpha
from evaweb.statistics.boundaries import MOST, SHAPES, Boundary, StoppingTable, boundary, pair_counts
from evaweb.statistics.difference import Difference, barnard
from evaweb.statistics.permutation import sign_flip_test
from evaweb.statistics.sequential import score_evidence, success_evidence
from evaweb.statistics.stagewise import stagewise

FIXED, ANYTIME = "none", "evidence"  # values of plans in the database: they must not change
RULES = (FIXED, ANYTIME, *SHAPES)
SUCCESS, SCORE = "success", "score"
_TIE = 1e-9  # relative tolerance: p equals alpha up to its last bits
Values = tuple[float, float]  # outcomes of the first and the second arm in one paired block
Block = Sequence[tuple[int, float]]  # arm and outcome of each counted trial, in the schedule's order


@dataclass(frozen=True, slots=True)
class Design:
    """Frozen design of a plan's comparisons.

    Attributes:
        rule: "none": fixed number of blocks with one test at the end; "evidence": e-process after every pair; "late",
            "early": exact `boundary` at its looks.
        blocks: Number of blocks at most.
        alpha: Error probability of all comparisons together.
        margin: If None, the question is whether two arms differ. Otherwise it is whether the first arm's success rate
            is lower than the second's by less than the margin.
        outcome: "success" or "score".
        boundary: Boundary of each comparison, if the rule has one.
        comparisons: Pairs of arms, each tested at its share of `alpha`.
        drops: Whether an arm is no longer tried once a comparison found it worse, or all its comparisons have ended.
        counts: Trials of both arms after each block [blocks, 2]; None if every block has one of each.
        holm: Whether comparisons with one test at the end are decided by Holm's procedure: in ascending order of p,
            each at `alpha` divided by the number of comparisons not decided yet, up to the first that is not
            significant.
    """

    rule: str
    blocks: int
    alpha: float
    margin: float | None = None
    outcome: str = SUCCESS
    boundary: Boundary | None = None
    comparisons: tuple[tuple[int, int], ...] = ((0, 1),)
    drops: bool = False
    counts: tuple[tuple[int, int], ...] | None = None
    holm: bool = False

    @property
    def share(self) -> float:
        """Alpha of each comparison."""
        return self.alpha / len(self.comparisons)

    @property
    def unit(self) -> str:
        """Unit in which the design counts its sequence of trials: "pairs" or "blocks"."""
        return "pairs" if self.counts is None else "blocks"


@dataclass(frozen=True, slots=True)
class Conclusion:
    """Conclusion of a design about one comparison.

    Attributes:
        blocks: Number of blocks made so far.
        ended_at_pair: Number of blocks after which the comparison ended; None while it continues.
        winner: Arm ("first" or "second") for which a boundary was crossed or the final test was significant.
        p: p-value of the single test, if the design has a fixed number of trials; None with any other rule.
        foreseen: Number of blocks of the design.
        dropped: Whether the comparison ended because one of its arms was dropped.
    """

    blocks: int
    ended_at_pair: int | None
    winner: str | None
    p: float | None
    foreseen: int
    dropped: bool = False

    @property
    def ended(self) -> str:
        """How the comparison ended: "full" if all blocks are made, "boundary" if it ended before; "" while it
        continues.
        """
        return (
            ""
            if self.ended_at_pair is None
            else "full"
            if self.ended_at_pair == self.foreseen
            else "boundary"
        )


@dataclass(frozen=True, slots=True)
class Findings:
    """Conclusions of a design about all its comparisons; `dropped` maps arms to the block after which they were
    dropped.
    """

    each: tuple[Conclusion, ...]
    dropped: dict[int, int]

    @property
    def at(self) -> int | None:
        """Number of blocks after which the last comparison ended; None while any continues."""
        ends = [conclusion.ended_at_pair for conclusion in self.each if conclusion.ended_at_pair is not None]
        return max(ends) if len(ends) == len(self.each) else None

    @property
    def ended(self) -> str:
        """Value of `Conclusion.ended` of the comparison that ended last; "" while any continues."""
        return (
            ""
            if self.at is None
            else next(conclusion.ended for conclusion in self.each if conclusion.ended_at_pair == self.at)
        )


def design(
    *,
    rule: str,
    blocks: int,
    alpha: float,
    margin: float | None = None,
    outcome: str = SUCCESS,
    looks: Sequence[int] = (),
    comparisons: Sequence[tuple[int, int]] = ((0, 1),),
    drops: bool = False,
    counts: Sequence[tuple[int, int]] | None = None,
    holm: bool = False,
) -> Design:
    """Return a design and compute its boundary.

    `looks` are the numbers of blocks after which the data are looked at; if empty, they are looked at after every
    block.

    Raises:
        StatisticsError: If the combination is not allowed: a margin with a rule that allows no margin, looks with a
            rule that allows no looks, an exact boundary with more than 250 trials per arm, or arms in random order with
            scores or an e-process.
    """
    check_design(
        rule=rule,
        blocks=blocks,
        alpha=alpha,
        margin=margin,
        outcome=outcome,
        looks=looks,
        comparisons=comparisons,
        drops=drops,
        paired=counts is None,
    )
    exact = rule in SHAPES or (rule == FIXED and margin is not None)
    unbounded = Design(
        rule,
        blocks,
        alpha,
        margin,
        outcome,
        None,
        tuple(comparisons),
        drops,
        tuple(counts) if counts is not None else None,
        holm,
    )
    return replace(unbounded, boundary=_bounded(unbounded, looks)) if exact else unbounded


def check_design(
    *,
    rule: str,
    blocks: int,
    alpha: float,
    margin: float | None = None,
    outcome: str = SUCCESS,
    looks: Sequence[int] = (),
    comparisons: Sequence[tuple[int, int]] = ((0, 1),),
    drops: bool = False,
    paired: bool = True,
) -> None:
    """Raise the errors that `design` would raise for the same arguments, without computing a boundary.

    `paired` is False if two arms are tried in random order.

    Raises:
        StatisticsError: If the arguments are invalid.
    """
    check_alpha(alpha)
    if rule not in RULES:
        raise StatisticsError(f"design = {rule!r}; allowed: {', '.join(RULES)}")
    if outcome not in (SUCCESS, SCORE):
        raise StatisticsError(f"outcome = {outcome!r}; allowed: {SUCCESS}, {SCORE}")
    if blocks < 1:
        raise StatisticsError(f"{blocks} pairs; allowed: 1 or more")
    if looks and rule not in SHAPES:
        raise StatisticsError(
            f"looks = {list(looks)} with the design {rule!r}; allowed with: {', '.join(SHAPES)}"
        )
    if looks and not 1 <= min(looks) <= max(looks) <= blocks:
        raise StatisticsError(f"looks = {list(looks)}; allowed: from 1 to {blocks}, the number of pairs")
    if drops and rule == FIXED:
        raise StatisticsError(
            f"arms are dropped with the design {rule!r}; allowed with: {', '.join(RULES[1:])}"
        )
    if drops and len(comparisons) < 2:
        raise StatisticsError("arms are dropped with 1 comparison; allowed: 2 or more")
    exact = rule in SHAPES or (rule == FIXED and margin is not None)
    if outcome == SCORE and exact:
        raise StatisticsError(f"outcome = {SCORE!r} with a boundary of successes; allowed: {SUCCESS}")
    if margin is not None and not exact:
        raise StatisticsError(
            f"margin = {margin:g} with the design {rule!r}; allowed with: none, {', '.join(SHAPES)}"
        )
    if not paired and (outcome == SCORE or rule == ANYTIME or len(comparisons) != 1):
        raise StatisticsError(
            "two arms in random order; allowed with: success, one comparison, and the designs "
            f"{', '.join(name for name in RULES if name != ANYTIME)}"
        )
    if exact and paired and blocks > MOST:
        raise StatisticsError(f"{blocks} pairs of a design with an exact boundary; allowed: 1 to {MOST}")


def _bounded(unbounded: Design, schedule: Sequence[int]) -> Boundary:
    at = [unbounded.blocks] if unbounded.rule == FIXED else list(schedule) or None
    shape = (
        unbounded.rule if unbounded.rule in SHAPES else "late"
    )  # with a single look the shape of spending has no effect
    if unbounded.counts is None:
        counts = pair_counts(unbounded.blocks, at)
    else:
        chosen = (
            range(unbounded.blocks)
            if at is None
            else [number - 1 for number in sorted({*at, unbounded.blocks})]
        )
        # With a margin, a boundary tests its second arm: the comparison's first.
        sides = (0, 1) if unbounded.margin is None else (1, 0)
        counted = (
            (unbounded.counts[number][sides[0]], unbounded.counts[number][sides[1]]) for number in chosen
        )
        counts = [count for count in counted if min(count) > 0]
    return boundary(counts, alpha=unbounded.share, shape=shape, margin=unbounded.margin)


def findings(found: Design, blocks: Sequence[Block]) -> Findings:
    """Return the conclusions of a design from `blocks`, given in the schedule's order up to the first incomplete block.

    Comparisons are decided in the order of the blocks at which they end, so that the result does not depend on which
    trial finishes first.

    If arms are dropped, a block is complete when it has all arms that were not dropped before it. When an arm is found
    worse, its other comparisons end too. An exception is a control that is in all comparisons: they continue. With a
    margin, no arm is ever found worse.
    """
    trials = blocks[: found.blocks]
    if not found.drops:
        conclusions = [evaluate_design(found, trials, pair) for pair in found.comparisons]
        return Findings(tuple(_stepped(found, trials, conclusions) if found.holm else conclusions), {})
    decided: dict[int, Conclusion] = {}
    dropped: dict[int, int] = {}
    arms = sorted({arm for pair in found.comparisons for arm in pair})
    spared = set(arms) if found.margin is not None else set(arms).intersection(*found.comparisons)
    while len(decided) < len(found.comparisons):
        complete = _whole(trials, arms, dropped)
        open_ = {
            n: evaluate_design(found, complete, pair)
            for n, pair in enumerate(found.comparisons)
            if n not in decided
        }
        first = min(
            (
                conclusion.ended_at_pair
                for conclusion in open_.values()
                if conclusion.ended_at_pair and conclusion.winner
            ),
            default=None,
        )
        if first is None:
            decided |= open_
            break
        crossed = {
            n: replace(conclusion, blocks=first)
            for n, conclusion in open_.items()
            if conclusion.ended_at_pair == first and conclusion.winner
        }
        decided |= crossed
        worse = {
            found.comparisons[n][conclusion.winner == "first"] for n, conclusion in crossed.items()
        } - spared
        for n in open_.keys() - crossed.keys():
            if worse & {*found.comparisons[n]}:
                decided[n] = Conclusion(first, first, None, None, found.blocks, dropped=first < found.blocks)
        still = {arm for n, pair in enumerate(found.comparisons) if n not in decided for arm in pair}
        dropped |= {arm: first for arm in arms if arm not in still and arm not in dropped}
    return Findings(tuple(decided[n] for n in range(len(found.comparisons))), dropped)


def unbeaten(found: Design, said: Findings) -> list[int]:
    """Return the arms that no comparison found worse, for a design that has ended."""
    pairs = zip(found.comparisons, said.each, strict=True)
    beaten = {pair[conclusion.winner == "first"] for pair, conclusion in pairs if conclusion.winner}
    return [arm for arm in sorted({arm for pair in found.comparisons for arm in pair}) if arm not in beaten]


def _stepped(frozen: Design, blocks: Sequence[Block], conclusions: list[Conclusion]) -> list[Conclusion]:
    """Return the conclusions by Holm's procedure; unchanged until every comparison has its test."""
    tests = {
        number: conclusion.p for number, conclusion in enumerate(conclusions) if conclusion.p is not None
    }
    if len(tests) < len(conclusions):
        return conclusions
    decided = list(conclusions)
    for tested, number in enumerate(sorted(tests, key=lambda number: tests[number])):
        left = replace(frozen, alpha=frozen.alpha * len(conclusions) / (len(conclusions) - tested))
        decided[number] = evaluate_design(left, blocks, frozen.comparisons[number])
        if decided[number].winner is None:
            break
    return decided


def _whole(blocks: Sequence[Block], arms: Sequence[int], dropped: dict[int, int]) -> list[Block]:
    """Return the blocks up to the first incomplete one, which is not returned.

    A block is incomplete if it lacks an arm that was still in use. `dropped` maps each dropped arm to the number of
    blocks after which it was dropped.
    """
    complete = []
    for number, block in enumerate(blocks):
        present = {arm for arm, _ in block}
        if any(arm not in present and dropped.get(arm, number + 1) > number for arm in arms):
            break
        complete.append(block)
    return complete


def evaluate_design(found: Design, blocks: Sequence[Block], pair: tuple[int, int] = (0, 1)) -> Conclusion:
    """Return the conclusion about one comparison, up to the first block that lacks one of its trials.

    Blocks beyond those of the design are ignored.
    """
    sides = list(_complete_blocks(found, blocks[: found.blocks], pair))
    full = len(sides) if len(sides) == found.blocks else None
    if found.boundary is not None:
        at, winner = _first_crossing(found.boundary, sides)
        return Conclusion(len(sides), at or full, winner, None, found.blocks)
    if found.rule == ANYTIME:
        of = score_evidence if found.outcome == SCORE else _of_successes
        evidence = of([(first[0], second[0]) for first, second in sides], found.share)
        return Conclusion(len(sides), evidence.stop or full, evidence.winner, None, found.blocks)
    if full is None:
        return Conclusion(len(sides), None, None, None, found.blocks)
    p, lead = _scored(sides) if found.outcome == SCORE else _succeeded(sides)
    winner = _ahead(lead, 0) if p <= found.share * (1 + _TIE) else None
    return Conclusion(full, full, winner, p, found.blocks)


def estimated(
    found: Design, blocks: Sequence[Block], pair: tuple[int, int], one: Conclusion
) -> Difference | None:
    """Return the difference of rates with which a comparison ended, corrected for early stopping.

    None if the rule has no boundary, the design has a margin, or the comparison was dropped or continues.
    """
    if found.boundary is None or found.margin is not None or one.ended_at_pair is None or one.dropped:
        return None
    sides = list(_complete_blocks(found, blocks[: one.ended_at_pair], pair))
    (first, n), (second, m) = (_sum(sides, side) for side in (0, 1))
    if (n, m) not in [(table.first, table.second) for table in found.boundary.looks]:
        return None
    return stagewise(found.boundary, first, n, second, m)


Sides = tuple[list[float], list[float]]  # outcomes of the first and of the second arm in one block


def _complete_blocks(frozen: Design, blocks: Sequence[Block], pair: tuple[int, int]) -> Iterator[Sides]:
    """Yield, for each block before the first incomplete one, the outcomes of either arm of `pair`."""
    before = (0, 0)
    for number, block in enumerate(blocks):
        sides = ([value for arm, value in block if arm == pair[0]], [v for arm, v in block if arm == pair[1]])
        after = (number + 1, number + 1) if frozen.counts is None else frozen.counts[number]
        if (len(sides[0]), len(sides[1])) != (after[0] - before[0], after[1] - before[1]):
            return
        before = after
        yield sides


def _succeeded(blocks: Sequence[Sides]) -> tuple[float, float]:
    """Return the p-value of a design with one test after a fixed number of blocks, and the difference of the rates.

    The difference is the first arm's success rate minus the second's. Without trials of an arm, the p-value is 1 and
    the difference is 0.
    """
    (first, n), (second, m) = (_sum(blocks, side) for side in (0, 1))
    if not n or not m:
        return 1.0, 0.0
    return barnard(first, n, second, m).p, first / n - second / m


def _sum(blocks: Sequence[Sides], side: int) -> tuple[int, int]:
    """Return successes and trials of one side."""
    return sum(bool(v) for sides in blocks for v in sides[side]), sum(len(sides[side]) for sides in blocks)


def _scored(blocks: Sequence[Sides]) -> tuple[float, float]:
    flips = sign_flip_test([first[0] - second[0] for first, second in blocks])
    return flips.p, flips.value


def _of_successes(values: Sequence[Values], alpha: float):  # type: ignore[no-untyped-def]
    return success_evidence([(bool(first), bool(second)) for first, second in values], alpha)


def _first_crossing(limits: Boundary, blocks: Sequence[Sides]) -> tuple[int | None, str | None]:
    """Return the number of blocks after which the boundary was crossed and the winning side, or (None, None)."""
    # With a margin, a boundary tests its second arm: the comparison's first.
    sides = (0, 1) if limits.margin is None else (1, 0)
    totals = [(0, 0), (0, 0)]  # (successes, trials) by side
    numbers = {(table.first, table.second): number for number, table in enumerate(limits.looks)}
    for at, block in enumerate(blocks, start=1):
        totals = [
            (wins + sum(bool(v) for v in block[side]), trials + len(block[side]))
            for side, (wins, trials) in zip(sides, totals, strict=True)
        ]
        number = numbers.get((totals[0][1], totals[1][1]))
        winner = None if number is None else limits.winner(number, totals[0][0], totals[1][0])
        if winner:
            return at, winner if limits.margin is None else "first"
    return None, None


def _ahead(first: float, second: float) -> str:
    return "first" if first > second else "second"


def alone(found: Design, pair: tuple[int, int], blocks: Sequence[Block]) -> tuple[Design, list[Block]]:
    """Return one comparison of a paired design as a design of its own, and the blocks with trials of both its arms.

    The new design has the comparison's share of alpha; `pair` are the indices of the arms. This is used to check
    conclusions of a design that dropped arms: the later blocks of such a design lack some arms.
    """
    both = [block for block in blocks if {*pair} <= {arm for arm, _ in block}]
    return replace(found, alpha=found.share, comparisons=(pair,), drops=False), both


def of_so_many(found: Design, blocks: int) -> Design:
    """Return the design `found` of one comparison, but planned for `blocks` blocks; looks beyond them are omitted."""
    schedule = look_schedule(found) if found.rule in SHAPES else []
    shortened = design(
        rule=found.rule,
        blocks=blocks,
        alpha=found.alpha,
        margin=found.margin,
        outcome=found.outcome,
        looks=[] if len(schedule) == found.blocks else [number for number in schedule if number <= blocks],
    )
    return replace(shortened, comparisons=found.comparisons)


def in_blocks(values: Sequence[Values]) -> list[Block]:
    """Return one block of two trials for each pair of outcomes: the first of arm 0, the second of arm 1."""
    return [((0, first), (1, second)) for first, second in values]


def look_schedule(found: Design) -> list[int]:
    """Return the numbers of blocks at which the boundary has looks; [] without a boundary."""
    tables = found.boundary.looks if found.boundary else ()
    return [(table.first + table.second) // 2 for table in tables]  # a block of a comparison has two trials


def boundary_table(found: Boundary) -> list[list[int]]:
    """Return the boundary as JSON, with one list of integers per look.

    A list has the trials of the first and the second arm. If a table can stop at this look, the successes of both arms
    in the least extreme such table follow.
    """
    return [[table.first, table.second, *(table.least or ())] for table in found.looks]


def boundary_from_table(rows: Sequence[Sequence[int]], alpha: float, margin: float | None) -> Boundary:
    """Return the boundary from rows of `boundary_table`."""
    tables = (StoppingTable(n, m, (least[0], least[1]) if least else None) for n, m, *least in rows)
    return Boundary(tuple(tables), alpha, margin)
