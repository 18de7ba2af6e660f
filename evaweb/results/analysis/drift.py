"""Anchors: checkpoints that are tried again in plan after plan, so that it shows when a bench or its scoring drifts."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from django.db.models import Q

from evaweb.plans.models import Handout, Plan, PlanState
from evaweb.statistics.strata import Table, exact_within
from evaweb.trials.models import TrialStatus


class _Tried(NamedTuple):
    plan: Plan
    condition: tuple[str, str, int]  # station, scene, position
    success: bool


def anchors_of(plan: Plan) -> list[dict[str, Any]]:
    """Of each anchor of a frozen plan its successes in this and in earlier plans, and two probabilities: that this plan
    differs from those before it, and its own second half from its first, by chance alone as much as they do.

    Each is within station, scene and position; None where nothing is to be compared. Earlier plans are those frozen
    before it that are sealed for nobody, as far as they had the anchor and a scene as this one has them.
    """
    found = []
    for row in (plan.document or {}).get("checkpoints", ()):
        if row.get("anchor"):
            own = _tried(row["name"], [plan])
            before = _tried(row["name"], _earlier(plan, row))
            alike = {other.pk: _same_scenes(plan, other) for other in {each.plan for each in before}}
            before = [each for each in before if each.condition[1] in alike[each.plan.pk]]
            half = len(own) // 2
            found.append(
                {
                    "checkpoint": row["name"],
                    "plans": list(_by_plan([*before, *own])),
                    "against_earlier": _differ(before, own),
                    "within": _differ(own[:half], own[half:]),
                }
            )
    return found


def _earlier(plan: Plan, row: dict[str, Any]) -> list[Plan]:
    told = Q(state=PlanState.REVEALED) | Q(blind=False, state=PlanState.CLOSED)
    rows = Plan.objects.filter(told, frozen_at__lt=plan.frozen_at).exclude(pk=plan.pk)
    return [
        other
        for other in rows
        if any(_undescribed(row) == _undescribed(there) for there in (other.document or {})["checkpoints"])
    ]


def _undescribed(row: dict[str, Any]) -> dict[str, Any]:
    return {**row, "description": ""}


def _same_scenes(one: Plan, other: Plan) -> set[str]:
    """Names of the scenes that both have with the same words, milestones and time limits."""
    ours, theirs = (
        {scene["name"]: {**scene, "positions": None} for scene in (plan.document or {})["scenes"]}
        for plan in (one, other)
    )
    return {name for name, scene in ours.items() if theirs.get(name) == scene}


def _tried(name: str, plans: Sequence[Plan]) -> list[_Tried]:
    """Trials that count, in the order in which they were handed out."""
    if not plans:
        return []
    rows = Handout.objects.filter(
        plan__in=plans, slot__checkpoint__name=name, trial__status=TrialStatus.SCORED
    ).order_by("handed_at", "pk")
    by_key = {plan.pk: plan for plan in plans}
    told = ("trial__station__name", "slot__scene__name", "slot__position__number", "trial__verdict__success")
    return [
        _Tried(by_key[plan], (station, scene, position), success)
        for plan, station, scene, position, success in rows.values_list("plan_id", *told)
    ]


def _by_plan(rows: Iterable[_Tried]) -> Iterator[dict[str, Any]]:
    tried: dict[Plan, list[bool]] = defaultdict(list)
    for each in rows:
        tried[each.plan].append(each.success)
    for plan, outcomes in sorted(tried.items(), key=lambda row: row[0].frozen_at):
        yield {
            "plan": plan.name,
            "version": plan.version,
            "frozen_at": plan.frozen_at,
            "successes": sum(outcomes),
            "n": len(outcomes),
        }


def _differ(before: Sequence[_Tried], since: Sequence[_Tried]) -> float | None:
    """Exact within each condition; two-sided."""
    conditions = sorted({each.condition for each in (*before, *since)})
    tables = []
    for condition in conditions:
        sides = [[each.success for each in rows if each.condition == condition] for rows in (before, since)]
        (one, n), (other, m) = ((sum(side), len(side)) for side in sides)
        if n and m:
            tables.append(Table(one, n, other, m))
    return exact_within(tables, least=1)
