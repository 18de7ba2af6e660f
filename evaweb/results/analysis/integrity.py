"""What was taken out, repeated or changed in an evaluation, by checkpoint."""

from __future__ import annotations

from dataclasses import dataclass, field

from django.db.models import F, OuterRef, Subquery

from evaweb.plans.models import Plan
from evaweb.trials.models import Score, Trial, TrialStatus


@dataclass
class Changes:
    """Of one checkpoint: attempts, and those that do not count.

    Voided trials are told apart by what their score said before (`voided_unscored`: there was none); of `asked`
    the void waits for a second operator. Scores that were corrected: `to_success`, `to_failure`, and `late` those
    after the reveal.
    """

    checkpoint: str
    attempts: int = 0
    counted: int = 0
    voided_successes: int = 0
    voided_failures: int = 0
    voided_unscored: int = 0
    asked: int = 0
    interrupted: int = 0
    abandoned: int = 0
    to_success: int = 0
    to_failure: int = 0
    late: int = 0
    operators: set[str] = field(default_factory=set)
    stations: set[str] = field(default_factory=set)

    @property
    def voided(self) -> int:
        """Voided trials, whatever was said of them before."""
        return self.voided_successes + self.voided_failures + self.voided_unscored


def changes_of(plan: Plan) -> list[Changes]:
    """Those of each checkpoint, in the order of their names; two queries whatever the number of trials."""
    found: dict[str, Changes] = {}
    trials = Trial.objects.filter(handout__plan=plan).order_by("checkpoint__name")
    for name, status, success, operator, station in trials.values_list(
        "checkpoint__name", "status", "verdict__success", "operator__username", "station__name"
    ):
        row = found.setdefault(name, Changes(name))
        row.attempts += 1
        row.counted += status == TrialStatus.SCORED
        row.voided_successes += status == TrialStatus.VOIDED and success is True
        row.voided_failures += status == TrialStatus.VOIDED and success is False
        row.voided_unscored += status == TrialStatus.VOIDED and success is None
        row.asked += status == TrialStatus.VOID_ASKED
        row.interrupted += status == TrialStatus.INTERRUPTED
        row.abandoned += status == TrialStatus.ABANDONED
        row.operators.add(operator)
        row.stations.add(station)
    for name, success, before, at in _corrections(plan):
        row = found[name]
        row.to_success += success and not before
        row.to_failure += before and not success
        row.late += bool(plan.revealed_at and at >= plan.revealed_at)
    return list(found.values())


def _corrections(plan: Plan):  # type: ignore[no-untyped-def]
    """Checkpoint, what the correction says, what the score before it said, and when it was made."""
    earlier = Score.objects.filter(trial=OuterRef("trial"), pk__lt=OuterRef("pk")).order_by("-pk")
    return (
        Score.objects.filter(trial__handout__plan=plan)
        .annotate(before=Subquery(earlier.values("success")[:1]))
        .exclude(before=None)
        .order_by("pk")
        .values_list(F("trial__checkpoint__name"), "success", "before", "scored_at")
    )
