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

    Each has a description, the pairs left, the sentence, and whether the conclusion is the same. Trials are left out by
    whole blocks. The remaining blocks are judged by the design's rule, each comparison on its own, as if it had been
    planned for this many (at its step of Holm's procedure, if used); with checkpoints in random order by one test of
    all. If the design has not ended, nothing is left out, because nothing was concluded. `matches` is the smallest
    bench match by trial, if known.
    """
    found = frozen_design(plan.document) if plan.document else None
    if found is None:
        return []
    attempts = attempts_of(plan)
    kept = stored_blocks(plan)
    at = (tuple(attempts), None if kept is None else tuple(kept), tuple(sorted(matches.items())), plan.state)
    return _kept.get(
        (plan.pk, plan.digest), at, lambda: list(_alternatives(plan, found, attempts, matches, kept))
    )


def _alternatives(
    plan: Plan,
    found: Design,
    attempts: Sequence[Attempt],
    matches: Mapping[int, float],
    kept: Sequence[Block] | None,
) -> Iterator[dict[str, Any]]:
    now = blocks_of(found, arms_of(compared(plan.document or {})), attempts)
    base = list(now.counted if kept is None else kept)
    decided = findings(found, base)

    def said(what: str, blocks: list[Block]) -> dict[str, Any]:
        way = findings(found, blocks)
        same = _concluded(way.each) == _concluded(decided.each) if blocks else None
        sentence = sentence_of(plan, found, blocks) if blocks else f"No {found.unit[:-1]} is left"
        return {"what": what, "pairs": _made(way), "sentence": sentence, "same": same}

    yield said("as it was decided", base)
    yield said("with the scores as they are now", now.counted)
    yield said("as trials were first scored, none voided", now.at_first)
    worst = in_the_worst_case(plan, found, base, now)
    if any(one.winner for one in decided.each):
        yield {
            "what": "attempts discarded unscored counted against it",
            "pairs": _made(decided),
            "sentence": ". ".join(told.sentence for told in worst) or sentence_of(plan, found, base),
            "same": all(told.same for told in worst),
        }
    if not decided.ended:
        return
    counting: dict[int, list[Attempt]] = defaultdict(list)
    for each in attempts:
        if each.counts:
            counting[each.block].append(each)

    def without(what: str, part: Callable[[Attempt], bool]) -> dict[str, Any]:
        left = [at for at in range(len(base)) if not any(map(part, counting[at]))]
        if not left or len(left) == len(base):  # nothing was removed: the decided result
            return said(what, [base[at] for at in left])
        told: list[str] = []
        ways: list[Conclusion] = []
        for number, (by, blocks) in enumerate(
            _stepped(found, [_of_these(found, p, left, base) for p in found.comparisons])
        ):
            if not blocks:
                first, second = compared(plan.document or {})[number]
                told.append(f"No pair of {first} and {second} is left")
                continue
            sentence, way = conclude_alone(plan, by, number, blocks)
            told.append(sentence)
            ways.append(way)
        same = _concluded(ways) == _concluded(decided.each) if len(ways) == len(told) else None
        pairs = max((one.blocks for one in ways), default=0)
        return {"what": what, "pairs": pairs, "sentence": ". ".join(told), "same": same}

    for field in ("operator", "station"):
        for name in sorted({getattr(each, field) for rows in counting.values() for each in rows}):
            yield without(
                f"without {field} {name}", lambda each, name=name, field=field: getattr(each, field) == name
            )
    yield without("only first attempts", lambda each: each.attempt > 1)
    if declared := declared_failures(plan):
        yield without("without failures by the plan's declaration", lambda each: each.trial in declared)
    gate = (plan.document or {}).get("match_gate")
    if gate is not None:
        low = f"without trials whose bench matched less than {gate:g}"
        yield without(low, lambda each: matches.get(each.trial, 1.0) < gate)


def _made(found: Findings) -> int:
    return max(one.blocks for one in found.each)


def _concluded(each: Iterable[Conclusion]) -> list[tuple[str | None, bool]]:
    return [(one.winner, bool(one.ended)) for one in each]


def _of_these(
    found: Design, pair: tuple[int, int], left: Sequence[int], base: Sequence[Block]
) -> tuple[Design, list[Block]]:
    """Return the design of one comparison as if planned for only the blocks at the indices `left`, and these blocks."""
    blocks = [base[at] for at in left]
    if found.counts is None:
        single, both = alone(found, pair, blocks)
        return (of_so_many(single, len(both)) if both else single), both
    counts, total = [], (0, 0)
    for at in left:
        before = found.counts[at - 1] if at else (0, 0)
        total = tuple(
            sum(each) for each in zip(total, found.counts[at], (-before[0], -before[1]), strict=True)
        )
        counts.append(total)
    if not min(total):  # trials of one checkpoint alone allow no conclusion
        return replace(found, rule=FIXED, blocks=len(left), boundary=None, counts=tuple(counts)), blocks
    made = design(rule=FIXED, blocks=len(left), alpha=found.alpha, margin=found.margin, counts=counts)
    return made, blocks


_Left = list[tuple[Design, list[Block]]]  # by comparison: its own design, and the remaining blocks


def _stepped(found: Design, left: _Left) -> _Left:
    """Return the designs with their shares of alpha by Holm's procedure; unchanged if the plan does not use it.

    Comparisons without blocks count as steps too.
    """
    if not found.holm:
        return left
    stepped, count = list(left), len(left)
    tests = {
        n: evaluate_design(by, blocks, by.comparisons[0]).p for n, (by, blocks) in enumerate(left) if blocks
    }
    if None in tests.values():
        return left
    for done, number in enumerate(sorted(tests, key=lambda n: tests[n] or 0.0)):
        by, blocks = left[number]
        by = replace(by, alpha=found.alpha / (count - done))
        stepped[number] = by, blocks
        if evaluate_design(by, blocks, by.comparisons[0]).winner is None:
            break
    return stepped
