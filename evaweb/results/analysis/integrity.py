"""Removed, repeated and changed trials of an evaluation, by checkpoint."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

from django.db.models import Count, F, QuerySet

from evaweb.plans.counting import end_of
from evaweb.plans.models import CountsAs, Plan
from evaweb.trials.models import MilestoneOutcome, Score, Trial, TrialStatus

VERDICT, CATEGORY, NOTE = "verdict", "category", "note"
"""What a score changes of the previous score: success, score or milestones; or only the failure's category;
or only the note.
"""


@dataclass
class CheckpointChanges:
    """Numbers of one checkpoint's attempts, of attempts that do not count, and of scores that were changed.

    Attributes:
        voided_successes: Voided trials whose last score is a success.
        voided_failures: Voided trials whose last score is a failure.
        voided_unscored: Voided trials without a score.
        asked: Trials with a void request that waits for a second operator.
        estop: Runs that were ended by an e-stop.
        interruption: Runs that were ended by an interruption.
        timeout: Runs that were ended by the time limit.
        declared: Trials that count as failures by the plan's rules, whatever was reached.
        to_success: Scores that were corrected from failure to success.
        to_failure: Scores that were corrected from success to failure.
        late: Corrections after the reveal, except those that changed only the category of a failure.
    """

    checkpoint: str
    attempts: int = 0
    counted: int = 0
    voided_successes: int = 0
    voided_failures: int = 0
    voided_unscored: int = 0
    asked: int = 0
    estop: int = 0
    interruption: int = 0
    timeout: int = 0
    declared: int = 0
    interrupted: int = 0
    abandoned: int = 0
    to_success: int = 0
    to_failure: int = 0
    late: int = 0
    operators: set[str] = field(default_factory=set)
    stations: set[str] = field(default_factory=set)

    @property
    def voided(self) -> int:
        """Number of voided trials."""
        return self.voided_successes + self.voided_failures + self.voided_unscored


def checkpoint_changes(plan: Plan) -> list[CheckpointChanges]:
    """Return the changes of each checkpoint by name; the number of queries does not depend on the number of trials."""
    by_checkpoint: dict[str, CheckpointChanges] = {}
    needed = Trial.objects.filter(handout__plan=plan).exclude(status=TrialStatus.NOT_NEEDED)
    trials = needed.order_by("checkpoint__name")
    ends = ("ended_by", "status", "reason", "episode__status", "episode__frames")
    for name, status, success, operator, station, *end, frames in trials.values_list(
        "checkpoint__name", "status", "verdict__success", "operator__username", "station__name", *ends
    ):
        row = by_checkpoint.setdefault(name, CheckpointChanges(name))
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
        ended = "" if status == TrialStatus.VOIDED and end[0] is None else end_of(*end)
        if ended:
            setattr(row, ended, getattr(row, ended) + 1)
            fails = getattr(plan, f"on_{ended}") == CountsAs.FAILURE
            row.declared += fails and bool(frames) and status == TrialStatus.SCORED
    scores = Score.objects.filter(trial__handout__plan=plan)
    for score in with_changes(scores, name=F("trial__checkpoint__name"), at=F("scored_at")):
        earlier, success = score["earlier"], score["success"]
        if earlier is None:
            continue
        row = by_checkpoint[score["name"]]
        row.to_success += success and not earlier["success"]
        row.to_failure += earlier["success"] and not success
        row.late += score["changed"] == VERDICT and bool(plan.stored_at and score["at"] > plan.stored_at)
    return list(by_checkpoint.values())


def with_changes(scores: QuerySet[Score], **named: F) -> list[dict[str, Any]]:
    """Return the scores as dicts in the order in which they were given, with the additional fields `named`.

    `scores` must contain all scores of each trial. In each dict, key "earlier" is the dict of the trial's previous
    score, None for a first score. Key "changed" is the kind of change, VERDICT for a first score. This takes one query,
    and one more if a score has the same success and points as the previous one.
    """
    fields = ("pk", "trial_id", "success", "score", "failure_phase", "failure")
    rows = list(scores.order_by("pk").values(*fields, **named))
    newest: dict[int, dict[str, Any]] = {}
    for row in rows:
        row["earlier"] = newest.get(row["trial_id"])
        newest[row["trial_id"]] = row
    same = any(row["earlier"] and _same(row, ("success", "score")) for row in rows)
    outcomes = _outcomes(scores) if same else {}
    for row in rows:
        judged = row["earlier"] and _same(row, ("success", "score"))
        if judged and outcomes.get(row["pk"]) == outcomes.get(row["earlier"]["pk"]):
            row["changed"] = NOTE if _same(row, ("failure_phase", "failure")) else CATEGORY
        else:
            row["changed"] = VERDICT
    return rows


def _same(row: dict[str, Any], fields: tuple[str, ...]) -> bool:
    return all(row[name] == row["earlier"][name] for name in fields)


def _outcomes(scores: QuerySet[Score]) -> dict[int, list[tuple[Any, ...]]]:
    """Return the milestone outcomes by score, for trials with more than one score."""
    corrected = scores.order_by().values("trial").annotate(n=Count("pk")).filter(n__gt=1).values("trial")
    rows = MilestoneOutcome.objects.filter(score__trial__in=corrected).order_by("order")
    by_score: dict[int, list[tuple[Any, ...]]] = defaultdict(list)
    for score, *outcome in rows.values_list(
        "score", "order", "text", "points", "required", "reached", "at_s"
    ):
        by_score[score].append(tuple(outcome))
    return by_score
