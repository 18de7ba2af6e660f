"""Headline of an evaluation: the conclusion of its plan's design, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from evaweb.plans.design import (
    Names,
    Tried,
    arms_of,
    blocks_that_count,
    compared,
    frozen_design,
    same_blocks,
    visible_close_reason,
)
from evaweb.plans.models import Plan, PlanState
from evaweb.results.analysis.wording import format_points, p_words
from evaweb.results.presentation.setting import setting_of
from evaweb.statistics.designs import (
    FIXED,
    SUCCESS,
    Block,
    Conclusion,
    Design,
    Findings,
    alone,
    estimated,
    evaluate_design,
    findings,
    unbeaten,
)
from evaweb.statistics.difference import newcombe
from evaweb.statistics.multiple_comparisons import letters

# Plan format from which sign-flip tests of scores are worded as "differ": they test exchangeability, which scores with
# different spreads around one mean violate too.
_DIFFER = 6
_BEST = 6  # format from which the best of several is named
_UNDECIDED = 6  # format from which too few trials are reported as undecided


@dataclass(frozen=True, slots=True)
class Headline:
    """Headline: a sentence per planned comparison, how they were decided, and alternative headlines.

    An alternative is "" if it would be concluded from exactly the same outcomes as the headline.

    Attributes:
        corrected: Alternative with the scores as corrected after the reveal.
        at_first: Alternative with every first score and no voids.
        worst: Alternative in which every attempt without a score that was discarded counts against the result.
        estimates: Corrected differences of comparisons that stopped early.
        versions: Headlines of earlier versions of the plan.
        letters: Name and letters of each checkpoint, if all were compared with each other. Two checkpoints that share a
            letter were not separated.
        best: Sentence on the best checkpoint, if all were compared with each other; else "".
        setting: Robot, scenes, dates and scorers.
    """

    sentences: tuple[str, ...]
    method: str
    corrected: str = ""
    at_first: str = ""
    worst: str = ""
    estimates: tuple[str, ...] = ()
    versions: tuple[str, ...] = ()
    letters: tuple[tuple[str, str], ...] = ()
    best: str = ""
    setting: str = ""

    @property
    def all_sentences(self) -> tuple[str, ...]:
        """Sentence on the best checkpoint, if any, then one per comparison."""
        return (self.best, *self.sentences) if self.best else self.sentences

    @property
    def sentence(self) -> str:
        """All sentences as one text."""
        return ". ".join(self.all_sentences)

    @property
    def caveats(self) -> tuple[str, ...]:
        """Reservations about the headline, one text each, without corrections that were made after the reveal."""
        caveats = [*self.estimates]
        if self.at_first:
            caveats.append(
                "Some scored trials were voided, have a void pending, or had their score corrected before the reveal. "
                f"With every first score and no voids: {self.at_first}"
            )
        if self.worst:
            caveats.append(
                "Some attempts were discarded without a score. If each had ended in the worst way for this result: "
                f"{self.worst}"
            )
        if self.versions:
            caveats.append(
                "Each earlier version of the plan used its full alpha: read together, they err more often than alpha "
                f"says. {'. '.join(self.versions)}"
            )
        return tuple(caveats)

    @property
    def document(self) -> dict[str, Any]:
        """Headline as JSON."""
        return {**asdict(self), "letters": dict(self.letters), "caveats": list(self.caveats)}


def conclude(plan: Plan, found: Design, now: Tried, decided: Sequence[Block]) -> Headline:
    """Return the headline of a plan: the conclusion of its design `found` from the blocks `decided`.

    `decided` are the blocks that count. `now` are the current outcomes, from which the alternative headlines and the
    worst cases are made.
    """
    return Headline(
        sentences_of(plan, found, decided),
        f"{rule_text(plan)}, {alpha_text(found)}",
        _other(plan, found, now.counted, decided),
        _other(plan, found, now.at_first, decided),
        ". ".join(case.sentence for case in in_the_worst_case(plan, found, decided, now)),
        tuple(_estimates(plan, found, decided)),
        _versions(plan),
        letters_of(plan, found, decided),
        best_of(plan, found, decided),
        setting_of(plan),
    )


def alpha_text(found: Design) -> str:
    """Return alpha, and how many comparisons share it."""
    several = len(found.comparisons)
    how = "Holm over" if found.holm and found.rule == FIXED and found.margin is None else "shared by"
    return f"alpha {found.alpha:g}" + (f", {how} {several} comparisons" if several > 1 else "")


def rule_text(plan: Plan) -> str:
    """Return the stopping rule of the design in one or two words."""
    return str(plan.get_stopping_display()).partition(":")[0]


def sentence_of(plan: Plan, found: Design, blocks: Sequence[Block]) -> str:
    """Return the design's conclusion from these blocks: one sentence per comparison.

    A sentence on the best checkpoint precedes them, if there is one (see `best_of`).
    """
    return ". ".join(filter(None, (best_of(plan, found, blocks), *sentences_of(plan, found, blocks))))


def sentences_of(plan: Plan, found: Design, blocks: Sequence[Block]) -> tuple[str, ...]:
    """Return one sentence per comparison."""
    names = compared(plan.document or {})
    conclusions = findings(found, blocks).each
    return tuple(
        _sentence(plan, found, conclusion, pair, name, blocks)
        for conclusion, pair, name in zip(conclusions, found.comparisons, names, strict=True)
    )


def letters_of(plan: Plan, found: Design, blocks: Sequence[Block]) -> tuple[tuple[str, str], ...]:
    """Return (name, letters) of each checkpoint, best first; two that share a letter were not separated.

    () unless all checkpoints were compared with each other and every comparison has ended.
    """
    names = compared(plan.document or {})
    arms = arms_of(names)
    results = findings(found, blocks)
    if not _ranks(found, arms, results):
        return ()
    rates = {name: _mean(blocks, number) for number, name in enumerate(arms)}
    ranked = sorted(arms, key=lambda name: (-rates[name], name))
    apart = {
        frozenset(name) for name, conclusion in zip(names, results.each, strict=True) if conclusion.winner
    }
    return tuple((name, letter) for name, letter in letters(ranked, apart).items())


def _ranks(design: Design, arms: Sequence[str], results: Findings) -> bool:
    """Return True if three or more checkpoints were all compared with each other, and every comparison has ended."""
    of_all = len(arms) > 2 and len(design.comparisons) == len(arms) * (len(arms) - 1) // 2
    return of_all and design.margin is None and bool(results.ended)


def best_of(plan: Plan, found: Design, blocks: Sequence[Block]) -> str:
    """Return the sentence on the best of three or more checkpoints, or on those that no comparison found worse.

    Return "" unless all checkpoints were compared with each other and every comparison has ended. Return "" too for a
    fixed number of trials compared by scores: that test only shows whether two checkpoints differ.
    """
    document = plan.document or {}
    arms, results = arms_of(compared(document)), findings(found, blocks)
    differ = found.outcome != SUCCESS and found.rule == FIXED
    if document.get("format", 1) < _BEST or differ or not _ranks(found, arms, results):
        return ""
    left = unbeaten(found, results)
    if len(left) == 1:
        return f"{arms[left[0]]} is the best of {len(arms)}"
    if not left:
        return f"No best of {len(arms)} was found: each was found worse than another"
    means = {arm: _mean(blocks, arm) for arm in left}
    highest = [arms[arm] for arm in left if means[arm] == max(means.values())]
    of = "success rate" if found.outcome == SUCCESS else "mean score"
    names = _listed([arms[arm] for arm in left])
    return f"No single best of {len(arms)}: {names} were not told apart (highest {of}: {_listed(highest)})"


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _mean(blocks: Sequence[Block], arm: int) -> float:
    values = [value for block in blocks for number, value in block if number == arm]
    return sum(values) / len(values) if values else 0.0


def _sentence(
    plan: Plan,
    design: Design,
    conclusion: Conclusion,
    pair: tuple[int, int],
    names: Names,
    blocks: Sequence[Block],
) -> str:
    first, second = names
    if not conclusion.ended:
        progress = f"{conclusion.blocks} of {design.blocks} {design.unit}"
        if plan.state == PlanState.FROZEN:
            return f"{first} and {second} are not compared yet: {progress} are made, and the design goes on"
        if visible_close_reason(plan, sealed=True):  # the design had ended with other scores
            return f"{first} and {second} would not be compared yet after {progress}: the design would go on"
        return f"{first} and {second} were not compared: closed after {progress}, before the design ended"
    sides = [
        [v for block in blocks[: conclusion.ended_at_pair] for arm, v in block if arm == side]
        for side in pair
    ]
    if conclusion.winner == "second":  # the better checkpoint is named first
        sides.reverse()
    counts = _counts(design, conclusion, *sides)
    if design.margin is not None:
        claim = f"{first} is {'' if conclusion.winner else 'not shown to be '}not worse than {second}"
        return f"{claim} by {100 * design.margin:g} points or more: {counts}"
    if (
        conclusion.winner is None
        and not conclusion.dropped
        and not _could_separate(plan, design, pair, blocks)
    ):
        return f"Undecided: {conclusion.ended_at_pair} {design.unit} cannot tell {first} and {second} apart: {counts}"
    if conclusion.winner is None:
        suffix = ", when one of them was dropped" if conclusion.dropped else ""
        return f"No significant difference between {first} and {second}: {counts}{suffix}"
    better, worse = (first, second) if conclusion.winner == "first" else (second, first)
    if design.outcome == SUCCESS:
        return f"{better} succeeded more often than {worse}: {counts}"
    if design.rule == FIXED and (plan.document or {}).get("format", 1) >= _DIFFER:
        return f"Scores of {better} and {worse} differ: {counts}"
    return f"{better} reached higher scores than {worse}: {counts}"


def _could_separate(plan: Plan, design: Design, pair: tuple[int, int], blocks: Sequence[Block]) -> bool:
    """Return True if trials as many as in `blocks` could have separated the pair at all.

    That is checked with the most extreme outcomes: every trial of the pair's first checkpoint succeeds, and every other
    trial fails.
    """
    if (plan.document or {}).get("format", 1) < _UNDECIDED:
        return True
    apart = [tuple((arm, float(arm == pair[0])) for arm, _ in block) for block in blocks]
    return findings(design, apart).each[design.comparisons.index(pair)].winner is not None


def _counts(design: Design, conclusion: Conclusion, first: Sequence[float], second: Sequence[float]) -> str:
    n, m = len(first), len(second)
    if design.outcome != SUCCESS:
        chance = "" if conclusion.p is None else f", {p_words(conclusion.p)},"
        return f"mean scores {sum(first) / n:.2f} and {sum(second) / m:.2f}{chance} after {n} pairs"
    text = f"{sum(first):.0f}/{n} against {sum(second):.0f}/{m}"
    if conclusion.p is not None:  # fixed number: an interval of the difference has its nominal coverage
        if n and m:
            text += f", difference {format_points(newcombe(int(sum(first)), n, int(sum(second)), m))}"
        text += f", {p_words(conclusion.p)}"
    return f"{text}, after {conclusion.ended_at_pair} of {design.blocks} {design.unit}"


def _other(plan: Plan, design: Design, blocks: Sequence[Block], decided: Sequence[Block]) -> str:
    """Return the conclusion from `blocks`; "" if they are the same as `decided`."""
    return "" if same_blocks(blocks, decided) else sentence_of(plan, design, blocks)


def _estimates(plan: Plan, design: Design, blocks: Sequence[Block]) -> Iterator[str]:
    """Yield the corrected estimate of each comparison that stopped at a boundary.

    The raw difference of such a comparison is too large on average.
    """
    rows = zip(compared(plan.document or {}), design.comparisons, findings(design, blocks).each, strict=True)
    for (first, second), pair, conclusion in rows:
        difference = (
            estimated(design, blocks, pair, conclusion)
            if conclusion.ended == "boundary" and conclusion.winner
            else None
        )
        if difference is None:
            continue
        if conclusion.winner == "second":
            first, second, difference = second, first, difference.swapped
        yield (
            f"{first} is ahead of {second} by {format_points(difference)}, corrected for stopping early "
            "(median unbiased over all ways in which the design can end; where it ends early this is still mostly "
            "too large, the raw difference more so)"
        )


@dataclass(frozen=True, slots=True)
class WorstCase:
    """Conclusion of a comparison in the worst case for its winner.

    In this case, attempts that were discarded without a score count against the winner. `same` is True if the winner
    still wins.
    """

    sentence: str
    same: bool


def in_the_worst_case(plan: Plan, found: Design, decided: Sequence[Block], now: Tried) -> list[WorstCase]:
    """Return the worst case of each comparison that has a winner and discarded attempts.

    `decided` are the blocks by which the comparisons were decided; `now` are the trials with their discarded attempts.
    """
    cases = []
    now = _as_decided(now, decided)
    for number, conclusion in enumerate(findings(found, decided).each):
        pair = found.comparisons[number]
        blocks = (
            now.against(*(pair if conclusion.winner == "first" else pair[::-1]))
            if conclusion.winner
            else now.counted
        )
        if blocks != now.counted:
            # Other outcomes would have dropped other arms, whose trials do not exist: each comparison counts on its
            # own, up to its end.
            single, both = (
                alone(found, pair, blocks[: conclusion.ended_at_pair]) if found.drops else (found, blocks)
            )
            sentence, worst = conclude_alone(plan, single, number, both)
            cases.append(WorstCase(sentence, worst.winner == conclusion.winner))
    return cases


def _as_decided(now: Tried, decided: Sequence[Block]) -> Tried:
    """Return `now` with the blocks `decided` in place of its counted blocks.

    `now` is returned unchanged if `decided` is not from the same trials.
    """
    if len(now.counted) != len(decided):
        return now
    outcomes: list[Block] = []
    for block, before in zip(now.counted, decided, strict=True):
        left = [*before]
        matched = []
        for arm, _ in block:
            at = next((i for i, (candidate, _) in enumerate(left) if candidate == arm), None)
            if at is None:
                return now
            matched.append(left.pop(at))
        if left:
            return now
        outcomes.append(tuple(matched))
    return replace(now, counted=outcomes)


def conclude_alone(
    plan: Plan, single: Design, number: int, blocks: Sequence[Block]
) -> tuple[str, Conclusion]:
    """Return the sentence and the conclusion of comparison `number` of the plan.

    The conclusion is drawn from `blocks` by the design `single`.
    """
    names = compared(plan.document or {})[number]
    pair = single.comparisons[number if len(single.comparisons) > 1 else 0]
    conclusion = evaluate_design(single, blocks, pair)
    return _sentence(plan, single, conclusion, pair, names, blocks), conclusion


def _versions(plan: Plan) -> tuple[str, ...]:
    """Return the headline of each earlier version of the plan, newest first, and why that version was amended.

    These headlines are shown as a caveat, because each version used its own full alpha.
    """
    sentences, version = [], plan.amends
    while version is not None:
        design = frozen_design(version.document) if version.document else None
        if design is not None:
            sentence = sentence_of(version, design, blocks_that_count(version))
            sentences.append(f"Version {version.version}: {sentence}. Amended because: {_amended(version)}")
        version = version.amends
    return tuple(sentences)


def _amended(version: Plan) -> str:
    return version.amendment.amended_because
