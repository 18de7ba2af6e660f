"""Loading of outcomes from the database, with a constant number of queries."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from datetime import datetime
from typing import Any

from django.db.models import QuerySet

from evaweb.plans.models import Plan
from evaweb.results.analysis.outcomes import Interruption, Outcome
from evaweb.trials.failures import FIELDS
from evaweb.trials.models import MilestoneOutcome, Score, Trial, TrialStatus

# Field of an outcome: field of a trial.
_RUN = {
    "trial": "pk",
    "checkpoint": "checkpoint__name",
    "scene": "scene__name",
    "position": "position__number",
    "duration": "duration_s",
    "station": "station__name",
    "operator": "operator__username",
}
_JUDGED = ("success", "score", "failure", "failure_phase")
_FIELDS = _RUN | {
    **{name: f"verdict__{name}" for name in _JUDGED},
    "smoothness": "episode__smoothness",
    "commanded": "episode__smoothness_commanded",
}


def load_plan_outcomes(plan: Plan, *, corrected: bool = False) -> list[Outcome]:
    """Return the outcomes of a plan that count, in order of allocation.

    If the plan is revealed, they have the scores at its reveal; with `corrected` the current ones. Causes of failure
    are always the current ones, because no comparison uses them.
    """
    trials = Trial.objects.filter(handout__plan=plan)
    blocks = dict(plan.handouts.values_list("trial_id", "slot__block"))
    order = dict(plan.handouts.values_list("trial_id", "number"))
    until = datetime.fromisoformat(plan.at_reveal["at"]) if plan.at_reveal and not corrected else None
    return _outcomes(trials, {trial: str(block) for trial, block in blocks.items()}, order, until)


def load_plan_interruptions(plan: Plan) -> list[Interruption]:
    """Return the runs of a plan that were interrupted and not scored."""
    broken = Trial.objects.filter(handout__plan=plan, status=TrialStatus.INTERRUPTED).order_by("pk")
    rows = broken.values_list(*_RUN.values())
    return [Interruption(**dict(zip(_RUN, row, strict=True))) for row in rows]


def _outcomes(
    trials: QuerySet[Trial], blocks: dict[int, str], order: dict[int, int], until: datetime | None
) -> list[Outcome]:
    """Return the outcomes of the scored trials in order of starting.

    With `until`, each has its newest score given by then, and trials without one are left out.
    """
    scored = trials.filter(status=TrialStatus.SCORED).order_by("started_at", "pk")
    rows = list(scored.values_list("verdict_id", "number", *_FIELDS.values()))
    earlier = {} if until is None else _scores_before(until, trials)
    milestones = _milestones(trials, earlier)
    outcomes = []
    for at, (newest, number, *values) in enumerate(rows):
        fields = dict(zip(_FIELDS, values, strict=True))
        verdict = newest
        if until is not None:
            if fields["trial"] not in earlier:
                continue
            verdict, judged = earlier[fields["trial"]]
            same = fields["success"] == judged["success"]  # the current cause may be more precise
            fields |= {name: value for name, value in judged.items() if not (same and name in FIELDS)}
        reached = milestones.get(verdict, [])
        outcomes.append(
            Outcome(
                order=order.get(fields["trial"], at),
                block=blocks.get(fields["trial"], f"{fields['scene']}/{fields['position']}/{number}"),
                milestones=tuple(ok for _, ok in reached),
                labels=tuple(text for text, _ in reached),
                **fields,
            )
        )
    return sorted(outcomes, key=lambda outcome: outcome.order)


def _scores_before(until: datetime, trials: QuerySet[Trial]) -> dict[int, tuple[int, dict[str, Any]]]:
    """Return for each trial the key and values of its newest score given at or before `until`."""
    scores = Score.objects.filter(trial__in=trials, scored_at__lte=until).order_by("pk")
    return {
        trial: (key, dict(zip(_JUDGED, values, strict=True)))
        for trial, key, *values in scores.values_list("trial_id", "pk", *_JUDGED)
    }


def _milestones(
    trials: QuerySet[Trial], earlier: dict[int, tuple[int, dict[str, Any]]]
) -> dict[int, list[tuple[str, bool]]]:
    """Return the milestones of each score, by the score's id: in order, each as text with whether it was reached.

    If `earlier` is empty, only the current score of each trial is included, otherwise all scores of each trial.
    """
    counting = (
        MilestoneOutcome.objects.filter(score__trial__in=trials)
        if earlier
        else MilestoneOutcome.objects.filter(score__in=trials.exclude(verdict=None).values("verdict"))
    )
    by_score: dict[int, list[tuple[str, bool]]] = defaultdict(list)
    rows: Iterable[tuple[int, str, bool]] = counting.order_by("score_id", "order").values_list(
        "score_id", "text", "reached"
    )
    for score, text, reached in rows:
        by_score[score].append((text, reached))
    return by_score
