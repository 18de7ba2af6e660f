"""Outcomes out of the database, in as many queries whatever their number."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from django.db.models import QuerySet

from evaweb.plans.models import Plan
from evaweb.results.analysis.outcomes import Interruption, Outcome
from evaweb.trials.models import MilestoneOutcome, Trial, TrialStatus

# What an outcome calls it, and where a trial has it.
_RUN = {
    "trial": "pk",
    "checkpoint": "checkpoint__name",
    "scene": "scene__name",
    "position": "position__number",
    "duration": "duration_s",
    "station": "station__name",
    "operator": "operator__username",
}
_FIELDS = _RUN | {
    "success": "verdict__success",
    "score": "verdict__score",
    "failure": "verdict__failure",
    "failure_phase": "verdict__failure_phase",
    "smoothness": "episode__smoothness",
    "commanded": "episode__smoothness_commanded",
}


def outcomes_of_plan(plan: Plan) -> list[Outcome]:
    """Those of a plan that count, in the order in which they were handed out."""
    trials = Trial.objects.filter(handout__plan=plan)
    blocks = dict(plan.handouts.values_list("trial_id", "slot__block"))
    order = dict(plan.handouts.values_list("trial_id", "number"))
    return _outcomes(trials, {trial: str(block) for trial, block in blocks.items()}, order)


def interruptions_of_plan(plan: Plan) -> list[Interruption]:
    """Runs of a plan that were broken off and not scored."""
    broken = Trial.objects.filter(handout__plan=plan, status=TrialStatus.INTERRUPTED).order_by("pk")
    rows = broken.values_list(*_RUN.values())
    return [Interruption(**dict(zip(_RUN, row, strict=True))) for row in rows]


def outcomes_of(trials: QuerySet[Trial]) -> list[Outcome]:
    """Those of any trials that count, in the order in which they were started.

    Trials of the same number at the same position met the same conditions as far as was meant.
    """
    return _outcomes(trials, {}, {})


def _outcomes(trials: QuerySet[Trial], blocks: dict[int, str], order: dict[int, int]) -> list[Outcome]:
    scored = trials.filter(status=TrialStatus.SCORED).order_by("started_at", "pk")
    rows = list(scored.values_list("verdict_id", "number", *_FIELDS.values()))
    milestones = _milestones(trials)
    found = []
    for at, (verdict, number, *told) in enumerate(rows):
        said = dict(zip(_FIELDS, told, strict=True))
        reached = milestones.get(verdict, [])
        found.append(
            Outcome(
                order=order.get(said["trial"], at),
                block=blocks.get(said["trial"], f"{said['scene']}/{said['position']}/{number}"),
                milestones=tuple(ok for _, ok in reached),
                labels=tuple(text for text, _ in reached),
                **said,
            )
        )
    return sorted(found, key=lambda outcome: outcome.order)


def _milestones(trials: QuerySet[Trial]) -> dict[int, list[tuple[str, bool]]]:
    """Of each score that counts, its milestones in their order."""
    counting = MilestoneOutcome.objects.filter(
        score__in=trials.filter(status=TrialStatus.SCORED).values("verdict")
    )
    found: dict[int, list[tuple[str, bool]]] = defaultdict(list)
    rows: Iterable[tuple[int, str, bool]] = counting.order_by("score_id", "order").values_list(
        "score_id", "text", "reached"
    )
    for score, text, reached in rows:
        found[score].append((text, reached))
    return found
