"""Rows of a plan's exports: every attempt with its position in the schedule and its current score, flat."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from datetime import datetime
from typing import Any, get_args

from django.db.models import QuerySet

from evaweb.core.tabular_export import in_pages
from evaweb.plans.counting import end_of
from evaweb.plans.models import Plan
from evaweb.results.models import Judgement, Rating
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.trials.models import MilestoneOutcome, Score, Trial, TrialStatus
from evaweb.trials.record import COLUMNS as RECORDED
from evaweb.trials.record import HINTS, TrialRecord


def _flat(hint: Any) -> Any:
    """Return the type of a field's column in exports.

    Numbers, times and booleans keep their type; any other becomes text. None stays allowed.
    """
    kinds = set(get_args(hint)) or {hint}
    if kinds - {type(None)} <= {bool, int, float, datetime}:
        return hint
    return str | None if type(None) in kinds else str


# Column: type and field of a trial; `milestones` is JSON: [[text, reached], ...].
_OF_PLAN: dict[str, tuple[Any, str]] = {
    "order": (int, "handout__number"),
    "slot": (int, "handout__slot__index"),
    "block": (str, "handout__slot__block"),
    "why_again": (str, "handout__reason"),
    "milestones": (str, "verdict_id"),
    "smoothness": (float | None, "episode__smoothness"),
    "smoothness_commanded": (float | None, "episode__smoothness_commanded"),
}
_CALLED = {"id": "trial", "number": "repetition"}  # columns of the record with another name here
# Order of the first exports; later columns follow.
_FIRST = (
    *("trial", "uuid", "order", "code", "slot", "block", "checkpoint", "scene", "position", "repetition"),
    *("attempt", "why_again", "station", "operator", "status", "reason", "success", "score", "milestones"),
    *("failure", "note", "rater", "source", "scored_at", "started_at", "ended_at", "duration_s"),
    *("smoothness", "smoothness_commanded", "episode"),
)
_ALL = _OF_PLAN | {
    _CALLED.get(name, name): (_flat(HINTS[name]), TrialRecord.path_of(name))
    for name, column in RECORDED.items()
    if column.table
}
_ORDER = dict.fromkeys((*_FIRST, *_ALL))
COLUMNS: dict[str, Any] = {name: _ALL[name][0] for name in _ORDER} | {
    "headline": str,
    "ended_by": str,
    "frames": int | None,
}
"""Columns of an export with their types; those of the score are empty without one.

`ended_by` is estop, interruption or timeout, empty for a normal end or one by the operator. `frames` is the number of
rows of its recording. `headline`, the same in each row, is the conclusion of the plan's design, so that it stays with
a table that is passed on.
"""
_FIELDS = [_ALL[name][1] for name in _ORDER]
_TEXTS = [name for name, hint in COLUMNS.items() if hint in (str, str | None)]
SCORE_COLUMNS = (
    *("trial", "rater", "source", "success", "score", "milestones", "failure", "failure_phase", "note"),
    *("reason", "scored_at"),
)
"""Columns of every score."""
PAGE = 1000


def outcome_pages(result: PlanResult, size: int = PAGE) -> Iterator[list[dict[str, Any]]]:
    """Yield the selected attempts in order of allocation, in pages."""
    rows, last = _attempts(result), 0
    while page := _rows(result, rows.filter(handout__number__gt=last)[:size]):
        yield page
        last = page[-1]["order"]


def outcome_page(result: PlanResult, offset: int, limit: int) -> dict[str, Any]:
    """Return one page of the selected attempts, and their total number."""
    rows = _attempts(result)
    return {
        "total": rows.count(),
        "limit": limit,
        "offset": offset,
        "items": _rows(result, rows[offset : offset + limit]),
    }


def _attempts(result: PlanResult) -> QuerySet[Trial]:
    only = result.only
    filters = {
        "scene__name": only.scene,
        "position__number": only.position,
        "station__name": only.station,
        "operator__username": only.operator,
    }
    rows = Trial.objects.filter(evaluation=result.plan.evaluation_id, handout__isnull=False)
    return rows.filter(**{name: value for name, value in filters.items() if value}).order_by(
        "handout__number"
    )


def _rows(result: PlanResult, attempts: QuerySet[Trial]) -> list[dict[str, Any]]:
    sentence, records = result.headline.sentence if result.headline else "", []
    for *row, stored_end, recording, frames in attempts.values_list(
        *_FIELDS, "ended_by", "episode__status", "episode__frames"
    ):
        values = dict(zip(_ORDER, row, strict=True))
        voided = values["status"] == TrialStatus.VOIDED  # its reason is a person's
        end = (
            ""
            if voided and stored_end is None
            else end_of(stored_end, values["status"], values["reason"], recording)
        )
        records.append(values | {"headline": sentence, "ended_by": end, "frames": frames})
    reached = milestones_of([row["milestones"] for row in records if row["milestones"]])
    for row in records:
        row["milestones"] = json.dumps(reached.get(row["milestones"], []), ensure_ascii=False)
        row |= {name: str(row[name]) for name in _TEXTS if row[name] is not None}
    return records


def milestones_of(scores: list[int]) -> dict[int, list[tuple[str, bool]]]:
    """Return a dict from the id of each score to its milestones, in order, as (text, whether it was reached)."""
    by_score: dict[int, list[tuple[str, bool]]] = defaultdict(list)
    rows = MilestoneOutcome.objects.filter(score__in=scores).order_by("score_id", "order")
    for score, text, reached in rows.values_list("score_id", "text", "reached"):
        by_score[score].append((text, reached))
    return by_score


def score_pages(plan: Plan) -> Iterator[list[dict[str, Any]]]:
    """Yield every score of the plan's trials in the order in which they were given, in pages."""
    rows = Score.objects.filter(trial__evaluation=plan.evaluation_id).order_by("pk")
    lookups = {"trial": "trial_id", "rater": "rater__username", "milestones": "pk"}
    fields = [lookups.get(name, name) for name in SCORE_COLUMNS]
    for page in in_pages(dict(zip(SCORE_COLUMNS, row, strict=True)) for row in rows.values_list(*fields)):
        reached = milestones_of([row["milestones"] for row in page])
        yield [
            {**row, "milestones": json.dumps(reached.get(row["milestones"], []), ensure_ascii=False)}
            for row in page
        ]


_RATINGS = (
    *("trial", "rater", "success", "score", "milestones", "failure", "failure_phase", "note", "blind", "at"),
)
_PREFERENCES = (
    "first",
    "second",
    "first_checkpoint",
    "second_checkpoint",
    "outcome",
    "why",
    "rater",
    "blind",
    "at",
)
_JUDGEMENTS = ("trial", "judge", "version", "model", "milestones", "reason", "prompt", "pictures", "at")


def _ratings(plan: Plan) -> list[dict[str, Any]]:
    rows = Rating.objects.filter(trial__evaluation=plan.evaluation_id).select_related("rater").order_by("pk")
    return [
        {
            **{name: getattr(row, name) for name in _RATINGS},
            "trial": row.trial_id,
            "rater": row.rater.get_username(),
            "milestones": json.dumps(row.milestones, ensure_ascii=False),
        }
        for row in rows
    ]


def _judgements(plan: Plan) -> list[dict[str, Any]]:
    rows = Judgement.objects.filter(trial__evaluation=plan.evaluation_id).order_by("pk")
    listed = ("milestones", "pictures")
    return [
        {
            **{name: getattr(row, name) for name in _JUDGEMENTS},
            "trial": row.trial_id,
            **{name: json.dumps(getattr(row, name), ensure_ascii=False) for name in listed},
        }
        for row in rows
    ]


def _preferences(plan: Plan) -> list[dict[str, Any]]:
    fields = ("first_id", "second_id", "first__checkpoint__name", "second__checkpoint__name")
    rows = plan.preferences.order_by("pk").values_list(
        *fields, "outcome", "why", "rater__username", "blind", "at"
    )
    return [dict(zip(_PREFERENCES, row, strict=True)) for row in rows]


JUDGED: dict[str, tuple[tuple[str, ...], Callable[[Plan], list[dict[str, Any]]]]] = {
    "ratings": (_RATINGS, _ratings),
    "preferences": (_PREFERENCES, _preferences),
    "judgements": (_JUDGEMENTS, _judgements),
}
"""Tables of ratings, preferences and judgements, with their columns."""
