"""What the headline of a plan would be without a part of its trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from evaweb.memo import Kept
from evaweb.plans.design import Attempt, attempts_of, frozen, paired_up
from evaweb.plans.models import Plan
from evaweb.results.presentation.headline import sentence_of
from evaweb.statistics.designs import Design, Values, conclude

_kept: Kept[list[dict[str, Any]]] = Kept()


def would_be(plan: Plan, matches: Mapping[int, float]) -> list[dict[str, Any]]:
    """As it was decided, then each other way to count: what, the pairs that it leaves, the sentence, and whether the
    same checkpoint is ahead by the design. None without a comparison.

    A part is left out by whole pairs. What is left is judged by the rule of the design as if it had foreseen so many
    pairs; where the design did not end nothing is left out, for nothing was concluded. `matches` is the lowest match
    of each trial's bench, where one was measured.
    """
    found = frozen(plan.document) if plan.document else None
    if found is None:
        return []
    attempts = attempts_of(plan)
    kept = tuple((one, other) for one, other in plan.at_reveal["pairs"]) if plan.at_reveal else None
    at = (tuple(attempts), kept, tuple(sorted(matches.items())), plan.state)
    return _kept.get((plan.pk, plan.digest), at, lambda: list(_ways(plan, found, attempts, matches, kept)))


def _ways(
    plan: Plan,
    found: Design,
    attempts: Sequence[Attempt],
    matches: Mapping[int, float],
    kept: Sequence[Values] | None,
) -> Iterator[dict[str, Any]]:
    names = (plan.document or {})["comparison"]
    pairs = paired_up(found, names, attempts)
    base = list(pairs.counted if kept is None else kept)
    decided = conclude(found, base)

    def said(what: str, values: list[Values], by: Design = found) -> dict[str, Any]:
        way = conclude(by, values)
        sentence = sentence_of(plan, by, values) if values else "No pair is left"
        same = (way.winner, bool(way.ended)) == (decided.winner, bool(decided.ended)) if values else None
        return {"what": what, "pairs": len(values), "sentence": sentence, "same": same}

    yield said("as it was decided", base)
    yield said("with the scores as they are now", pairs.counted)
    yield said("as trials were first scored, none voided", pairs.at_first)
    if decided.winner:
        yield said("what was thrown away unscored counted against it", pairs.against(decided.winner))
    if not decided.ended:
        return
    counting: dict[int, list[Attempt]] = {}
    for each in attempts:
        if each.counts:
            counting.setdefault(each.block, []).append(each)

    def without(what: str, part: Callable[[Attempt], bool]) -> dict[str, Any]:
        left = [pair for block, pair in enumerate(base) if not any(map(part, counting.get(block, ())))]
        return said(what, left, replace(found, pairs=max(len(left), 1)))

    for field in ("operator", "station"):
        for name in sorted({getattr(each, field) for rows in counting.values() for each in rows}):
            yield without(
                f"without {field} {name}", lambda each, name=name, field=field: getattr(each, field) == name
            )
    yield without("only first attempts", lambda each: each.attempt > 1)
    gate = (plan.document or {}).get("match_gate")
    if gate is not None:
        low = f"without trials whose bench matched less than {gate:g}"
        yield without(low, lambda each: matches.get(each.trial, 1.0) < gate)
