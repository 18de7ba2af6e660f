"""The rows of a plan's exports: every attempt with its place in the schedule and the score that counts, flat."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from datetime import datetime
from typing import Any, get_type_hints

from django.db.models import QuerySet

from evaweb.plans.models import Plan
from evaweb.results.analysis.filters import Chosen
from evaweb.trials.models import MilestoneOutcome, Trial


class OutcomeRow:
    """The columns; those of the score are empty where there is none. `milestones` is JSON: [[text, reached], ...]."""

    trial: int
    uuid: str
    order: int
    code: str
    slot: int
    block: str
    checkpoint: str
    scene: str
    position: int
    repetition: int
    attempt: int
    why_again: str
    station: str
    operator: str
    status: str
    reason: str
    success: bool | None
    score: float | None
    milestones: str
    failure: str | None
    note: str | None
    rater: str | None
    source: str | None
    scored_at: datetime | None
    started_at: datetime | None
    ended_at: datetime | None
    duration_s: float | None
    smoothness: float | None
    smoothness_commanded: float | None
    episode: str | None


COLUMNS: dict[str, Any] = get_type_hints(OutcomeRow)
_FIELDS = (
    ("trial", "pk"),
    ("uuid", "uuid"),
    ("order", "handout__number"),
    ("code", "handout__code"),
    ("slot", "handout__slot__index"),
    ("block", "handout__slot__block"),
    ("checkpoint", "checkpoint__name"),
    ("scene", "scene__name"),
    ("position", "position__number"),
    ("repetition", "number"),
    ("attempt", "attempt"),
    ("why_again", "handout__reason"),
    ("station", "station__name"),
    ("operator", "operator__username"),
    ("status", "status"),
    ("reason", "reason"),
    ("success", "verdict__success"),
    ("score", "verdict__score"),
    ("milestones", "verdict_id"),
    ("failure", "verdict__failure"),
    ("note", "verdict__note"),
    ("rater", "verdict__rater__username"),
    ("source", "verdict__source"),
    ("scored_at", "verdict__scored_at"),
    ("started_at", "started_at"),
    ("ended_at", "ended_at"),
    ("duration_s", "duration_s"),
    ("smoothness", "episode__smoothness"),
    ("smoothness_commanded", "episode__smoothness_commanded"),
    ("episode", "episode_id"),
)
PAGE = 1000


def outcome_pages(
    plan: Plan, which: Chosen | None = None, size: int = PAGE
) -> Iterator[list[dict[str, Any]]]:
    """All attempts that are meant, in the order in which they were handed out, a page at a time."""
    rows, last = _attempts(plan, which), 0
    while page := _rows(rows.filter(handout__number__gt=last)[:size]):
        yield page
        last = page[-1]["order"]


def outcome_page(plan: Plan, which: Chosen | None, offset: int, limit: int) -> dict[str, Any]:
    """Some of them, and how many there are."""
    rows = _attempts(plan, which)
    return {
        "total": rows.count(),
        "limit": limit,
        "offset": offset,
        "items": _rows(rows[offset : offset + limit]),
    }


def _attempts(plan: Plan, which: Chosen | None) -> QuerySet[Trial]:
    only = which or Chosen()
    wanted = {
        "scene__name": only.scene,
        "position__number": only.position,
        "station__name": only.station,
        "operator__username": only.operator,
    }
    rows = Trial.objects.filter(evaluation=plan.evaluation_id, handout__isnull=False)
    return rows.filter(**{name: value for name, value in wanted.items() if value}).order_by("handout__number")


def _rows(attempts: QuerySet[Trial]) -> list[dict[str, Any]]:
    rows = attempts.values_list(*(field for _, field in _FIELDS))
    found = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
    reached = _milestones([row["milestones"] for row in found if row["milestones"]])
    for row in found:
        row["milestones"] = json.dumps(reached.get(row["milestones"], []), ensure_ascii=False)
        row["uuid"], row["block"] = str(row["uuid"]), str(row["block"])
        row["episode"] = str(row["episode"]) if row["episode"] else None
    return found


def _milestones(scores: list[int]) -> dict[int, list[tuple[str, bool]]]:
    found: dict[int, list[tuple[str, bool]]] = defaultdict(list)
    rows = MilestoneOutcome.objects.filter(score__in=scores).order_by("score_id", "order")
    for score, text, reached in rows.values_list("score_id", "text", "reached"):
        found[score].append((text, reached))
    return found
