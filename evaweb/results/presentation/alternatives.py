"""Alternative headlines: the conclusion of a plan without a part of its trials."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from evaweb.core.fingerprint_cache import FingerprintCache
from evaweb.plans.counting import declared_failures
from evaweb.plans.design import (
    Attempt,
    arms_of,
    attempts_of,
    blocks_of,
    compared,
    frozen_design,
    stored_blocks,
)
from evaweb.plans.models import Plan
from evaweb.results.presentation.headline import conclude_alone, in_the_worst_case, sentence_of
from evaweb.statistics.designs import (
    FIXED,
    Block,
    Conclusion,
    Design,
    Findings,
    alone,
    design,
    evaluate_design,
    findings,
    of_so_many,
)

_kept: FingerprintCache[list[dict[str, Any]]] = FingerprintCache()


def headline_alternatives(plan: Plan, matches: Mapping[int, float]) -> list[dict[str, Any]]:
    """Return the headline as decided, then each alternative, as dicts; [] for a plan without a comparison.

    Each dict has a description, the number of pairs left, the sentence, and whether the conclusion is the same.

    Alternatives that omit trials, for example those of one operator, omit the whole blocks of these trials. Each
    comparison is then decided by the design's rule as if the design had been planned for the remaining blocks. If the
    plan uses Holm's procedure, the comparison is tested at the alpha that the procedure gives it. With checkpoints in
    random order, all remaining blocks are compared by one test. Before the design has ended there are no alternatives
    that omit trials, because nothing was concluded.

    `matches` maps the id of each trial with a known bench match to its smallest match.
    """
    frozen = frozen_design(plan.document) if plan.document else None
    if frozen is None:
        return []
    attempts = attempts_of(plan)
    stored = stored_blocks(plan)
    at = (
        tuple(attempts),
        None if stored is None else tuple(stored),
        tuple(sorted(matches.items())),
        plan.state,
    )
    return _kept.get(
        (plan.pk, plan.digest), at, lambda: list(_alternatives(plan, frozen, attempts, matches, stored))
    )


def _alternatives(
    plan: Plan,
    frozen: Design,
    attempts: Sequence[Attempt],
    matches: Mapping[int, float],
    stored: Sequence[Block] | None,
) -> Iterator[dict[str, Any]]:
    now = blocks_of(frozen, arms_of(compared(plan.document or {})), attempts)
    base = list(now.counted if stored is None else stored)
    decided = findings(frozen, base)

    def said(what: str, blocks: list[Block]) -> dict[str, Any]:
        conclusion = findings(frozen, blocks)
        same = _concluded(conclusion.each) == _concluded(decided.each) if blocks else None
        sentence = sentence_of(plan, frozen, blocks) if blocks else f"No {frozen.unit[:-1]} is left"
        return {"what": what, "pairs": _made(conclusion), "sentence": sentence, "same": same}

    yield said("as it was decided", base)
    yield said("with the scores as they are now", now.counted)
    yield said("as trials were first scored, none voided", now.at_first)
    worst = in_the_worst_case(plan, frozen, base, now)
    if any(result.winner for result in decided.each):
        yield {
            "what": "attempts discarded unscored counted against it",
            "pairs": _made(decided),
            "sentence": ". ".join(sentences.sentence for sentences in worst)
            or sentence_of(plan, frozen, base),
            "same": all(sentences.same for sentences in worst),
        }
    if not decided.ended:
        return
    counting: dict[int, list[Attempt]] = defaultdict(list)
    for attempt in attempts:
        if attempt.counts:
            counting[attempt.block].append(attempt)

    def without(what: str, part: Callable[[Attempt], bool]) -> dict[str, Any]:
        left = [at for at in range(len(base)) if not any(map(part, counting[at]))]
        if not left or len(left) == len(base):  # nothing was removed: the decided result
            return said(what, [base[at] for at in left])
        sentences: list[str] = []
        conclusions: list[Conclusion] = []
        for number, (by, blocks) in enumerate(
            _stepped(frozen, [_of_these(frozen, p, left, base) for p in frozen.comparisons])
        ):
            if not blocks:
                first, second = compared(plan.document or {})[number]
                sentences.append(f"No pair of {first} and {second} is left")
                continue
            sentence, conclusion = conclude_alone(plan, by, number, blocks)
            sentences.append(sentence)
            conclusions.append(conclusion)
        same = (
            _concluded(conclusions) == _concluded(decided.each)
            if len(conclusions) == len(sentences)
            else None
        )
        pairs = max((result.blocks for result in conclusions), default=0)
        return {"what": what, "pairs": pairs, "sentence": ". ".join(sentences), "same": same}

    for field in ("operator", "station"):
        for name in sorted({getattr(attempt, field) for rows in counting.values() for attempt in rows}):
            yield without(
                f"without {field} {name}",
                lambda attempt, name=name, field=field: getattr(attempt, field) == name,
            )
    yield without("only first attempts", lambda attempt: attempt.attempt > 1)
    if declared := declared_failures(plan):
        yield without("without failures by the plan's declaration", lambda attempt: attempt.trial in declared)
    gate = (plan.document or {}).get("match_gate")
    if gate is not None:
        low = f"without trials whose bench matched less than {gate:g}"
        yield without(low, lambda attempt: matches.get(attempt.trial, 1.0) < gate)


def _made(result: Findings) -> int:
    return max(conclusion.blocks for conclusion in result.each)


def _concluded(conclusions: Iterable[Conclusion]) -> list[tuple[str | None, bool]]:
    return [(conclusion.winner, bool(conclusion.ended)) for conclusion in conclusions]


def _of_these(
    original: Design, pair: tuple[int, int], left: Sequence[int], base: Sequence[Block]
) -> tuple[Design, list[Block]]:
    """Return one comparison's design, reduced to the blocks at the indices `left`, and these blocks.

    The design is the one that would result if only these blocks had been planned. `pair` are the indices of the
    comparison's arms, and `base` are all blocks.
    """
    blocks = [base[at] for at in left]
    if original.counts is None:
        single, both = alone(original, pair, blocks)
        return (of_so_many(single, len(both)) if both else single), both
    total: tuple[int, ...] = (0, 0)
    counts = []
    for at in left:
        before = original.counts[at - 1] if at else (0, 0)
        total = tuple(
            sum(cell) for cell in zip(total, original.counts[at], (-before[0], -before[1]), strict=True)
        )
        counts.append(total)
    if not min(total):  # trials of one checkpoint alone allow no conclusion
        return replace(original, rule=FIXED, blocks=len(left), boundary=None, counts=tuple(counts)), blocks
    fixed = design(rule=FIXED, blocks=len(left), alpha=original.alpha, margin=original.margin, counts=counts)
    return fixed, blocks


_Left = list[tuple[Design, list[Block]]]  # by comparison: its own design, and the remaining blocks


def _stepped(design: Design, left: _Left) -> _Left:
    """Return the comparisons with each design's alpha replaced by the share that Holm's procedure gives it.

    `left` contains the design and the remaining blocks of each comparison; the blocks are unchanged. `left` itself is
    returned if the plan does not use the procedure. A comparison without blocks counts as a step too.
    """
    if not design.holm:
        return left
    stepped, count = list(left), len(left)
    tests = {
        n: evaluate_design(by, blocks, by.comparisons[0]).p for n, (by, blocks) in enumerate(left) if blocks
    }
    if None in tests.values():
        return left
    for tested, number in enumerate(sorted(tests, key=lambda n: tests[n] or 0.0)):
        by, blocks = left[number]
        by = replace(by, alpha=design.alpha / (count - tested))
        stepped[number] = by, blocks
        if evaluate_design(by, blocks, by.comparisons[0]).winner is None:
            break
    return stepped
