"""The design of a plan's comparison: as it is drafted, as it is frozen, and what it says of the trials there are.

Blocks enter in the order of the schedule, never in that in which they were finished: the first one that lacks a scored
trial of either checkpoint ends what is looked at. A station that is fast cannot choose what counts.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any

from django.db.models import OuterRef, Subquery
from django.utils import timezone

from evaweb.errors import EvaError
from evaweb.plans.canonical import digest
from evaweb.plans.models import Plan
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.designs import SUCCESS, Conclusion, Design, Values, conclude, design, of_table
from evaweb.trials.lifecycle import JUDGED
from evaweb.trials.models import Score, TrialStatus

ENDED = {
    "boundary": "a boundary of its design was crossed",
    "full": "all pairs of its comparison are made",
}


def drafted(plan: Plan) -> Design | None:
    """The design of a draft, computed now; None without a comparison. EvaError says what cannot be."""
    if not (plan.first and plan.second):
        return None
    pairs = plan.positions.count() * plan.repetitions
    try:
        return design(
            rule=plan.stopping,
            pairs=pairs,
            alpha=plan.alpha,
            margin=plan.margin,
            outcome=plan.outcome,
            looks=looks_of(plan.look_after),
        )
    except StatisticsError as error:
        raise EvaError(str(error)) from None


def frozen(document: Mapping[str, Any]) -> Design | None:
    """The design of a frozen plan, also of one from before there were boundaries; None without a comparison."""
    if not document["comparison"]:
        return None
    said = {"outcome": SUCCESS, "margin": None, "boundary": None, **document["stopping"]}
    positions = sum(len(scene["positions"]) for scene in document["scenes"])
    rows, alpha, margin = said["boundary"], said["alpha"], said["margin"]
    return Design(
        said["rule"],
        positions * document["repetitions"],
        alpha,
        margin,
        said["outcome"],
        of_table(rows, alpha, margin) if rows else None,
    )


@dataclass(frozen=True, slots=True)
class Pairs:
    """Outcomes of the compared checkpoints, block by block as scheduled, up to the first block that is not made.

    `counted` is what counts; `at_first` as if no trial had been voided that had a score, nor were to be, and none
    corrected: of each slot the first score. `repeated` says of each pair that counts for which of the two an attempt
    was thrown away unscored.
    """

    counted: list[Values]
    at_first: list[Values]
    repeated: list[tuple[bool, bool]]

    def against(self, winner: str) -> list[Values]:
        """What counts, had each attempt that was thrown away unscored ended as badly for `winner` as it could."""
        worst = (0.0, 1.0) if winner == "first" else (1.0, 0.0)
        return [
            (worst[0] if again[0] else one, worst[1] if again[1] else other)
            for (one, other), again in zip(self.counted, self.repeated, strict=True)
        ]


@dataclass(frozen=True, slots=True)
class Attempt:
    """An attempt of one of the compared checkpoints that was judged or broken off, in block `block`.

    `counts`: its score is the one that counts; `outcome` is that of its newest score and `first` of its first one, None
    where it has none. `attempt` is above 1 where one before it did not count.
    """

    block: int
    checkpoint: str
    counts: bool
    outcome: float | None
    first: float | None
    trial: int
    attempt: int
    operator: str
    station: str


def attempts_of(plan: Plan) -> list[Attempt]:
    """Those of a frozen plan's comparison, in the order in which they were handed out; one query."""
    document = plan.document or {}
    found = frozen(document)
    if found is None:
        return []
    value = "success" if found.outcome == SUCCESS else "score"
    first = Score.objects.filter(trial=OuterRef("trial")).order_by("pk").values(value)[:1]
    rows = plan.handouts.filter(
        trial__status__in=(*JUDGED, TrialStatus.INTERRUPTED),
        slot__checkpoint__name__in=document["comparison"],
    ).order_by("number")
    named = ("trial_id", "trial__attempt", "trial__operator__username", "trial__station__name")
    told = ("slot__block", "slot__checkpoint__name", "trial__status", f"trial__verdict__{value}")
    return [
        Attempt(
            block,
            name,
            status == TrialStatus.SCORED,
            None if outcome is None else float(outcome),
            None if before is None else float(before),
            *who,
        )
        for block, name, status, outcome, before, *who in rows.values_list(*told, Subquery(first), *named)
    ]


def tried(plan: Plan) -> Pairs:
    """The pairs of a frozen plan as they are now; none without a comparison. One query."""
    found = frozen(plan.document or {})
    return (
        paired_up(found, (plan.document or {})["comparison"], attempts_of(plan))
        if found
        else Pairs([], [], [])
    )


def paired_up(found: Design, names: Sequence[str], attempts: Iterable[Attempt]) -> Pairs:
    """The pairs of these attempts, which are in the order in which they were handed out."""
    counted: dict[int, dict[str, float]] = defaultdict(dict)
    at_first: dict[int, dict[str, float]] = defaultdict(dict)
    thrown: set[tuple[int, str]] = set()
    for each in attempts:
        if each.outcome is None or each.first is None:
            thrown.add((each.block, each.checkpoint))
            continue
        at_first[each.block].setdefault(each.checkpoint, each.first)
        if each.counts:
            counted[each.block][each.checkpoint] = each.outcome

    def made(blocks: Mapping[int, Mapping[str, float]]) -> list[int]:
        return list(takewhile(lambda block: len(blocks.get(block, ())) == len(names), range(found.pairs)))

    def pairs(blocks: Mapping[int, Mapping[str, float]]) -> list[Values]:
        return [(blocks[block][names[0]], blocks[block][names[1]]) for block in made(blocks)]

    repeated = [((block, names[0]) in thrown, (block, names[1]) in thrown) for block in made(counted)]
    return Pairs(pairs(counted), pairs(at_first), repeated)


def pairs_of(plan: Plan) -> list[Values]:
    """The pairs that count."""
    return tried(plan).counted


def conclusion_of(plan: Plan) -> Conclusion | None:
    """What the frozen design says: of a revealed plan as it stood at the reveal, else of the trials there are now."""
    found = frozen(plan.document) if plan.document else None
    if found is None:
        return None
    return conclude(found, plan.at_reveal["pairs"] if plan.at_reveal else pairs_of(plan))


def ended_because(found: Conclusion) -> str:
    """Reason why a design has ended, which tells nothing of either checkpoint."""
    return f"{ENDED[found.ended]}, after {found.at} pairs"


def told_reason(plan: Plan, sealed: bool) -> str:
    """Why it was closed; of a plan that is `sealed` for the reader only what the server itself says."""
    own = any(plan.closed_because.startswith(f"{words}, after ") for words in ENDED.values())
    return plan.closed_because if own or not sealed else ""


def at_the_reveal(plan: Plan) -> dict[str, Any] | None:
    """The pairs that count and the sums of each checkpoint, kept with their digest: what is corrected later makes no
    other headline.
    """
    if frozen(plan.document or {}) is None:
        return None
    kept = {"pairs": [list(pair) for pair in pairs_of(plan)], "arms": _sums(plan)}
    return {**kept, "digest": digest({"plan": plan.digest, **kept}), "at": timezone.now().isoformat()}


def _sums(plan: Plan) -> list[dict[str, Any]]:
    """Of each checkpoint the trials that count, successes and mean score, in the order of the document."""
    rows = plan.handouts.filter(trial__status=TrialStatus.SCORED).order_by("number")
    found: dict[str, list[tuple[bool, float]]] = defaultdict(list)
    for name, success, score in rows.values_list(
        "slot__checkpoint__name", "trial__verdict__success", "trial__verdict__score"
    ):
        found[name].append((success, score))
    return [
        {
            "checkpoint": row["name"],
            "n": len(scored),
            "successes": sum(success for success, _ in scored),
            "score": math.fsum(score for _, score in scored) / len(scored) if scored else None,
        }
        for row in (plan.document or {})["checkpoints"]
        for scored in (found[row["name"]],)
    ]


def looks_of(given: Any) -> list[int]:
    """Pairs after which a design is looked at; EvaError where `given` is no list of numbers."""
    if not isinstance(given, list) or not all(
        isinstance(at, int) and not isinstance(at, bool) for at in given
    ):
        raise EvaError(f"looks = {given!r:.80}; allowed: a list of numbers of pairs, such as [20, 40, 60]")
    return given
