"""Design of a plan's comparisons: drafted, frozen, and applied to the trials so far.

Blocks are used in the order of the schedule, not of completion: the first block that lacks a scored trial of a compared
checkpoint ends the data of the analysis. So a fast station cannot influence which trials count.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import combinations
from typing import Any

from django.db.models import Count, Max, OuterRef, Subquery
from django.utils import timezone

from evaweb.core.canonical_json import digest
from evaweb.core.errors import EvaError
from evaweb.plans.models import Allocation, Comparing, Plan
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.designs import (
    SUCCESS,
    Block,
    Design,
    Findings,
    boundary_from_table,
    check_design,
    design,
    findings,
    in_blocks,
)
from evaweb.trials.lifecycle import SCORED_STATES
from evaweb.trials.models import Score, Trial, TrialStatus
from runtime.core.sentences import Pattern

_LOOKS_ALLOWED_LIST_RISING_NUMBERS = Pattern(
    "plans.design.looks_allowed_list_rising_numbers",
    "looks = {given!r:.80}; allowed: a list of rising numbers of pairs, such as [20, 40, 60]",
)

ENDED = {
    "boundary": "a boundary of its design was crossed",
    "full": "all pairs of its comparison are made",
}
ENDED_EVENT = "ended"  # plan event: found at a request for the next trial, or at the last trial
CROSSED_EVENT = "crossed"  # plan event: boundary found crossed at a request while a void request was open
_SINCE_HOLM = 6  # plan format from which several comparisons with one test use Holm's step-down procedure
_ALL_KEPT = 7  # plan format from which a reveal stores the result also without a comparison
_ENDS_NOTED = 6  # plan format from which every end found by the server is recorded as an event
Names = tuple[str, str]


def planned(plan: Plan) -> list[Names]:
    """Return the comparisons of a draft as pairs of names; [] if it has none."""
    # An anchor is compared only if it is named.
    names = list(plan.checkpoints.filter(anchor=False).order_by("name").values_list("name", flat=True))
    if plan.comparing == Comparing.ALL:
        return list(combinations(names, 2))
    if plan.first is None:
        return []
    if plan.comparing == Comparing.CONTROL:
        return [(name, plan.first.name) for name in names if name != plan.first.name]
    return [(plan.first.name, plan.second.name)] if plan.second else []


def compared(document: Mapping[str, Any]) -> list[Names]:
    """Return the comparisons of a frozen plan as pairs of names."""
    before = [document["comparison"]] if document.get("comparison") else []
    return [(first, second) for first, second in document.get("comparisons", before)]


def arms_of(comparisons: Sequence[Names]) -> list[str]:
    """Return the compared checkpoints in the order of the design's arms."""
    return list(dict.fromkeys(name for pair in comparisons for name in pair))


def draft_design(plan: Plan, counts: Sequence[tuple[int, int]] | None = None) -> Design | None:
    """Return the design of a draft, None without a comparison. Raises: EvaError if it is invalid.

    `counts`: for random order, the numbers of trials of both checkpoints after each block.
    """
    arguments = _design_arguments(plan)
    if arguments is None:
        return None
    try:
        return design(**arguments, counts=counts, holm=True)
    except StatisticsError as error:
        raise EvaError(str(error)) from None


def check_drafted(plan: Plan) -> None:
    """Raise EvaError if the draft's design is invalid; cheap, as it computes no boundary."""
    arguments = _design_arguments(plan)
    try:
        if arguments is not None:
            check_design(**arguments, paired=plan.allocation == Allocation.PAIRED)
    except StatisticsError as error:
        raise EvaError(str(error)) from None


def _design_arguments(plan: Plan) -> dict[str, Any] | None:
    """Return the arguments of `design` for a draft; None without a comparison."""
    comparisons = planned(plan)
    if not comparisons:
        return None
    return {
        "rule": plan.stopping,
        "blocks": plan.positions.count() * plan.repetitions,
        "alpha": plan.alpha,
        "margin": plan.margin,
        "outcome": plan.outcome,
        "looks": look_schedule(plan.look_after),
        "comparisons": _by_number(comparisons),
        "drops": plan.drop_arms,
    }


def _by_number(comparisons: Sequence[Names]) -> tuple[tuple[int, int], ...]:
    arms = arms_of(comparisons)
    return tuple((arms.index(first), arms.index(second)) for first, second in comparisons)


def frozen_design(document: Mapping[str, Any]) -> Design | None:
    """Return the design of a frozen plan of any format; None without a comparison."""
    comparisons = compared(document)
    if not comparisons:
        return None
    before = {"outcome": SUCCESS, "margin": None, "boundary": None, "drops": False, "counts": None}
    stopping = {**before, **document["stopping"]}
    positions = sum(len(scene["positions"]) for scene in document["scenes"])
    rows, alpha, margin = stopping["boundary"], stopping["alpha"], stopping["margin"]
    return Design(
        stopping["rule"],
        positions * document["repetitions"],
        alpha,
        margin,
        stopping["outcome"],
        boundary_from_table(rows, alpha / len(comparisons), margin) if rows else None,
        _by_number(comparisons),
        stopping["drops"],
        tuple((first, second) for first, second in stopping["counts"]) if stopping["counts"] else None,
        document.get("format", 1) >= _SINCE_HOLM,
    )


@dataclass(frozen=True, slots=True)
class Tried:
    """Outcomes of the compared checkpoints, block by block as scheduled, up to the last block that a comparison uses.

    `counted` are the outcomes that count. `at_first` has the first score of each slot, as if no scored trial had been
    voided or corrected. `again` is True for each trial that counts if an earlier attempt at it was discarded unscored.
    """

    counted: list[Block]
    at_first: list[Block]
    again: list[list[bool]]

    def against(self, winner: int, loser: int) -> list[Block]:
        """Return the blocks of `counted`, changed to the worst case for arm `winner` of a comparison with arm `loser`.

        The change affects each trial of these two arms with an earlier attempt that was discarded unscored. Such a
        trial gets outcome 0 if it is of `winner`, and outcome 1 if it is of `loser`.
        """
        worst = {winner: 0.0, loser: 1.0}
        return [
            tuple(
                (arm, worst.get(arm, value) if thrown else value)
                for (arm, value), thrown in zip(block, flags, strict=True)
            )
            for block, flags in zip(self.counted, self.again, strict=True)
        ]


@dataclass(frozen=True, slots=True)
class Attempt:
    """Scored or interrupted attempt at a trial of a compared checkpoint.

    Scores that were given after the plan's result was stored are ignored.

    Attributes:
        slot: Index of the scheduled trial.
        block: Block of that trial.
        counts: Whether the attempt's score counts.
        outcome: Outcome by the attempt's newest score, None without a score.
        first: Outcome by the attempt's first score, None without a score.
        attempt: Number of the attempt; above 1 if an earlier attempt did not count.
    """

    block: int
    slot: int
    checkpoint: str
    counts: bool
    outcome: float | None
    first: float | None
    trial: int
    attempt: int
    operator: str
    station: str


def attempts_of(plan: Plan) -> list[Attempt]:
    """Return the attempts of a frozen plan's comparisons in the order of handout; one query."""
    document = plan.document or {}
    frozen = frozen_design(document)
    if frozen is None:
        return []
    value = "success" if frozen.outcome == SUCCESS else "score"
    scores = Score.objects.filter(trial=OuterRef("trial"))
    if plan.stored_at:  # later scores do not belong to the evaluation
        scores = scores.filter(scored_at__lte=plan.stored_at)
    first = scores.order_by("pk").values(value)[:1]
    rows = plan.handouts.filter(
        trial__status__in=(*SCORED_STATES, TrialStatus.INTERRUPTED),
        slot__checkpoint__name__in=arms_of(compared(document)),
    ).order_by("number")
    named = ("trial_id", "trial__attempt", "trial__operator__username", "trial__station__name")
    fields = (
        "slot__block",
        "slot__index",
        "slot__checkpoint__name",
        "trial__status",
        f"trial__verdict__{value}",
    )
    return [
        Attempt(
            block,
            slot,
            name,
            status == TrialStatus.SCORED,
            None if outcome is None else float(outcome),
            None if before is None else float(before),
            *names,
        )
        for block, slot, name, status, outcome, before, *names in rows.values_list(
            *fields, Subquery(first), *named
        )
    ]


def current_pairs(plan: Plan) -> Tried:
    """Return the current outcomes of a frozen plan by block; empty without a comparison. Takes one query."""
    document = plan.document or {}
    frozen = frozen_design(document) if document else None
    if frozen is None:
        return Tried([], [], [])
    return blocks_of(frozen, arms_of(compared(document)), attempts_of(plan))


def blocks_of(found: Design, arms: Sequence[str], attempts: Iterable[Attempt]) -> Tried:
    """Return the outcomes by block of these attempts, which must be in the order of handout."""
    counted: dict[int, dict[int, tuple[int, float]]] = defaultdict(dict)
    at_first: dict[int, dict[int, tuple[int, float]]] = defaultdict(dict)
    thrown: set[int] = set()
    for attempt in attempts:
        arm = arms.index(attempt.checkpoint)
        if attempt.first is None:
            thrown.add(attempt.slot)
        else:
            at_first[attempt.block].setdefault(attempt.slot, (arm, attempt.first))
        if attempt.counts and attempt.outcome is not None:
            counted[attempt.block][attempt.slot] = (arm, attempt.outcome)

    def used(rows: Mapping[int, Mapping[int, tuple[int, float]]]) -> list[Block]:
        whole = [tuple(trial for _, trial in sorted(rows.get(at, {}).items())) for at in range(found.blocks)]
        return list(whole[: max(conclusion.blocks for conclusion in findings(found, whole).each)])

    now = used(counted)
    retried = [[slot in thrown for slot in sorted(counted.get(at, {}))] for at in range(len(now))]
    return Tried(now, used(at_first), retried)


def stored_blocks(plan: Plan) -> list[Block] | None:
    """Return the blocks stored by the reveal; None before it."""
    return blocks_of_record(plan.at_reveal) if plan.at_reveal else None


def blocks_of_record(kept: Mapping[str, Any]) -> list[Block]:
    """Return the blocks of a `reveal_record`; an old record, which stored pairs, is converted to blocks."""
    if "blocks" not in kept:
        return in_blocks([(first, second) for first, second in kept["pairs"]])
    return [tuple((arm, value) for arm, value in block) for block in kept["blocks"]]


def same_blocks(one: Sequence[Block], other: Sequence[Block]) -> bool:
    """Return True if both lists have the same trials in each block.

    The order within a block is ignored, because early versions of this program did not store it at the reveal of a
    plan.
    """
    return [sorted(block) for block in one] == [sorted(block) for block in other]


def blocks_that_count(plan: Plan) -> list[Block]:
    """Return the blocks of the reveal if there was one, else the current ones."""
    stored = stored_blocks(plan)
    return current_pairs(plan).counted if stored is None else stored


def findings_of(plan: Plan) -> Findings | None:
    """Return the findings of the frozen design from the blocks that count; None without a comparison.

    For a revealed plan, the blocks that count are those of the reveal, else the current ones.
    """
    frozen = frozen_design(plan.document) if plan.document else None
    if frozen is None:
        return None
    return findings(frozen, blocks_that_count(plan))


def dropped_of(plan: Plan) -> dict[str, int]:
    """Return the checkpoints that a running plan's rule has dropped, and after how many blocks.

    A trial that is being repeated counts with its score until its repetition is scored. If such a trial counted as
    missing, a drop could be undone; the omitted trials would then come next, and the operator would recognise their
    checkpoint.
    """
    frozen = frozen_design(plan.document) if plan.document else None
    if frozen is None or not frozen.drops:
        return {}
    arms = arms_of(compared(plan.document or {}))
    attempts = attempts_of(plan)
    counted_slots = {attempt.slot for attempt in attempts if attempt.counts}
    waiting = [
        replace(attempt, counts=attempt.slot not in counted_slots)
        for attempt in attempts
        if not attempt.counts
    ]
    result = findings(
        frozen,
        blocks_of(frozen, arms, [*waiting, *(attempt for attempt in attempts if attempt.counts)]).counted,
    )
    return {arms[arm]: at for arm, at in result.dropped.items() if result.at is None or at < result.at}


def end_reason(plan: Plan, found: Findings) -> str:
    """Return why a design has ended, without revealing any checkpoint."""
    planned = frozen_design(plan.document or {})
    return f"{ENDED[found.ended]}, after {found.at} {planned.unit if planned else 'pairs'}"


def end_at_request(plan: Plan) -> str:
    """Return the reason why the plan has ended, "" if it has not.

    The end is found when a trial is requested, or at the last trial.
    """
    text = plan.events.filter(what=ENDED_EVENT).values_list("text", flat=True).first()
    return text or ""


def crossed_while_waiting(plan: Plan, since: datetime) -> str:
    """Return the reason for which the plan would have ended if no void request had been open; "" if there is none.

    Only reasons that were recorded at or after `since` count. A reason is recorded when a trial is requested while the
    void request is open.
    """
    text = plan.events.filter(what=CROSSED_EVENT, at__gte=since).values_list("text", flat=True).first()
    return text or ""


def visible_close_reason(plan: Plan, sealed: bool) -> str:
    """Return the reason for which the plan was closed.

    If the plan is `sealed` for the reader, a reason that its owner gave is replaced by "". A reason that the server
    gave is always returned. Since format 6 the server's reason is recorded, and only an identical text counts as such.
    For older plans it is recognised by its first words, with which an owner's reason could begin too.
    """
    if (plan.document or {}).get("format", 1) < _ENDS_NOTED:
        own = any(plan.closed_because.startswith(f"{text}, after ") for text in ENDED.values())
    else:
        own = plan.closed_because == end_at_request(plan)
    return plan.closed_because if own or not sealed else ""


_told_of: list[Callable[[Plan], dict[str, Any]]] = []


def register_reveal_data(told: Callable[[Plan], dict[str, Any]]) -> None:
    """Register a function that returns further data to store when a plan is revealed."""
    _told_of.append(told)


def reveal_record(plan: Plan) -> dict[str, Any] | None:
    """Return the data stored at a reveal, with their digest: blocks that count, sums per checkpoint, registered data.

    Because the data are stored, later corrections do not change the plan's headline. The result is None for a plan that
    has no comparison and whose document has a format before 7.
    """
    document = plan.document or {}
    if frozen_design(document) is None and document.get("format", 1) < _ALL_KEPT:
        return None
    record = counted_now(plan)
    for part_of in _told_of:
        record |= part_of(plan)
    return {**record, "digest": digest({"plan": plan.digest, **record}), "at": timezone.now().isoformat()}


def recorded_so_far(plan: Plan) -> Hashable:
    """Return a fingerprint that changes whenever a trial, score, correction or void is added."""
    trials = Trial.objects.filter(evaluation=plan.evaluation_id)
    counts = trials.aggregate(n=Count("pk"), changed=Max("changed_at"), scores=Count("scores", distinct=True))
    return tuple(counts.values())


def counted_now(plan: Plan) -> dict[str, Any]:
    """Return the blocks that count now, and for each checkpoint its numbers of trials and successes and its mean
    score.
    """
    return {
        "blocks": [[list(trial) for trial in block] for block in current_pairs(plan).counted]
        if frozen_design(plan.document or {}) is not None
        else [],
        "arms": _sums(plan),
    }


def _sums(plan: Plan) -> list[dict[str, Any]]:
    """Return for each checkpoint the number of counting trials and of successes, and the mean score.

    The order is that of the plan's document.
    """
    rows = plan.handouts.filter(trial__status=TrialStatus.SCORED).order_by("number")
    by_checkpoint: dict[str, list[tuple[bool, float]]] = defaultdict(list)
    for name, success, score in rows.values_list(
        "slot__checkpoint__name", "trial__verdict__success", "trial__verdict__score"
    ):
        by_checkpoint[name].append((success, score))
    return [
        {
            "checkpoint": row["name"],
            "n": len(scored),
            "successes": sum(success for success, _ in scored),
            "score": math.fsum(score for _, score in scored) / len(scored) if scored else None,
        }
        for row in (plan.document or {})["checkpoints"]
        for scored in (by_checkpoint[row["name"]],)
    ]


def look_schedule(given: Any) -> list[int]:
    """Return the numbers of pairs after which looks take place. Raises: EvaError unless they are increasing."""
    numbers = isinstance(given, list) and all(
        isinstance(at, int) and not isinstance(at, bool) for at in given
    )
    if not numbers or sorted({*given}) != given:
        raise EvaError(_LOOKS_ALLOWED_LIST_RISING_NUMBERS(given=given))
    return list(given)
