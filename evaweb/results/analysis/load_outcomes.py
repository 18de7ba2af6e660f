"""Outcomes out of the database, in as many queries whatever their number."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from django.db.models import QuerySet

from evaweb.plans.models import Plan
from evaweb.results.analysis.outcomes import Interruption, Outcome
from evaweb.trials.models import MilestoneOutcome, Trial, TrialStatus

_FIELDS = (
    "pk",
    "verdict_id",
    "checkpoint__name",
    "scene__name",
    "position__number",
    "number",
    "duration_s",
    "station__name",
    "operator__username",
    "verdict__success",
    "verdict__score",
    "verdict__failure",
    "episode__smoothness",
    "episode__smoothness_commanded",
)


def outcomes_of_plan(plan: Plan) -> list[Outcome]:
    """Those of a plan that count, in the order in which they were handed out."""
    trials = Trial.objects.filter(handout__plan=plan)
    blocks = dict(plan.handouts.values_list("trial_id", "slot__block"))
    order = dict(plan.handouts.values_list("trial_id", "number"))
    return _outcomes(trials, {trial: str(block) for trial, block in blocks.items()}, order)


def interruptions_of_plan(plan: Plan) -> list[Interruption]:
    """Runs of a plan that were broken off and not scored."""
    broken = Trial.objects.filter(handout__plan=plan, status=TrialStatus.INTERRUPTED).order_by("pk")
    named = ("pk", "checkpoint__name", "scene__name", "position__number", "duration_s")
    return [Interruption(*row) for row in broken.values_list(*named, "station__name", "operator__username")]


def outcomes_of(trials: QuerySet[Trial]) -> list[Outcome]:
    """Those of any trials that count, in the order in which they were started.

    Trials of the same number at the same position met the same conditions as far as was meant.
    """
    return _outcomes(trials, {}, {})


def _outcomes(trials: QuerySet[Trial], blocks: dict[int, str], order: dict[int, int]) -> list[Outcome]:
    scored = trials.filter(status=TrialStatus.SCORED).order_by("started_at", "pk").values_list(*_FIELDS)
    rows = list(scored)
    milestones = _milestones(trials)
    found = []
    for at, row in enumerate(rows):
        (
            trial,
            verdict,
            checkpoint,
            scene,
            position,
            number,
            duration,
            station,
            operator,
            success,
            score,
            why,
            smoothness,
            commanded,
        ) = row
        reached = milestones.get(verdict, [])
        found.append(
            Outcome(
                trial=trial,
                order=order.get(trial, at),
                block=blocks.get(trial, f"{scene}/{position}/{number}"),
                checkpoint=checkpoint,
                scene=scene,
                position=position,
                success=success,
                score=score,
                duration=duration,
                milestones=tuple(ok for _, ok in reached),
                failure=why,
                station=station,
                operator=operator,
                labels=tuple(text for text, _ in reached),
                smoothness=smoothness,
                commanded=commanded,
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
