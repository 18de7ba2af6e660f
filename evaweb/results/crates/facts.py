"""Facts of a plan that its crate states: people, period, and the time of the newest record."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from django.db.models import Max, Min

from evaweb.plans.models import Plan
from evaweb.results.models import Judgement, Rating
from evaweb.trials.models import Score, Trial


@dataclass(frozen=True, slots=True)
class CrateFacts:
    """Facts of a plan.

    Attributes:
        owner: Username of the plan's owner.
        operators: Usernames of those who ran trials.
        raters: Usernames of those who scored, rated a second time or compared trials.
        started_at: Time of the first hand-out; without trials, of the freeze.
        ended_at: Time of the end of the last trial; without trials, of the freeze.
        recorded_at: Time of the newest record that the report contains.
    """

    owner: str
    operators: tuple[str, ...]
    raters: tuple[str, ...]
    started_at: datetime
    ended_at: datetime
    recorded_at: datetime


def crate_facts(plan: Plan) -> CrateFacts:
    """Return the facts of a plan that is frozen or later."""
    trials = Trial.objects.filter(evaluation=plan.evaluation_id).order_by()
    scores = Score.objects.filter(trial__evaluation=plan.evaluation_id).order_by()
    ratings = Rating.objects.filter(trial__evaluation=plan.evaluation_id).order_by()
    judgements = Judgement.objects.filter(trial__evaluation=plan.evaluation_id).order_by()
    period = trials.aggregate(first=Min("prepared_at"), last=Max("ended_at"))
    frozen_at = plan.frozen_at or datetime.fromtimestamp(0, UTC)
    newest = [
        *(plan.frozen_at, plan.closed_at, plan.revealed_at, period["first"], period["last"]),
        *(
            rows.aggregate(at=Max(field))["at"]
            for rows, field in (
                *((scores, "scored_at"), (ratings, "at"), (plan.preferences.order_by(), "at")),
                *((judgements, "at"), (plan.events.order_by(), "at")),
            )
        ),
    ]
    raters: set[Any] = set()
    for rows in (scores.filter(source=Score.Source.HUMAN), ratings, plan.preferences.order_by()):
        raters |= set(rows.values_list("rater__username", flat=True))
    return CrateFacts(
        owner=plan.owner.get_username(),
        operators=_ordered(trials.values_list("operator__username", flat=True)),
        raters=_ordered(raters),
        started_at=period["first"] or frozen_at,
        ended_at=period["last"] or period["first"] or frozen_at,
        recorded_at=max(filter(None, newest), default=frozen_at),
    )


def _ordered(names: Iterable[Any]) -> tuple[str, ...]:
    return tuple(sorted({str(name) for name in names if name}))
