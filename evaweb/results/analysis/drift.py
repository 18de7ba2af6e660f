"""Anchors: checkpoints that are tried again in every plan, to detect drift of a bench or of its scoring."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from django.db.models import Q

from evaweb.plans.models import Plan, PlanState
from evaweb.results.analysis.load_outcomes import load_plan_outcomes
from evaweb.statistics.stratified import StratumTable, exact_within


class _Tried(NamedTuple):
    plan: Plan
    condition: tuple[str, str, int]  # station, scene, position
    success: bool


def anchors_of(plan: Plan) -> list[dict[str, Any]]:
    """Return for each anchor of a frozen plan its successes by plan, and two p-values of tests for drift.

    Key `against_earlier` compares this plan with earlier ones, key `within` its first half with its second half. Each
    p-value is the probability that chance alone makes a difference at least as improbable as the observed one,
    stratified by station, scene and position; it is None if nothing can be compared.

    An earlier plan counts if it was frozen before this one, served the anchor in the same way, and is revealed or was
    never blind. Of its trials, only those in scenes that both plans have in identical form are used.
    """
    anchors = []
    for row in (plan.document or {}).get("checkpoints", ()):
        if row.get("anchor"):
            own = _tried(row["name"], plan, {scene["name"] for scene in plan.document["scenes"]})
            before = [
                trial
                for earlier in _earlier(plan, row)
                for trial in _tried(row["name"], earlier, _same_scenes(plan, earlier))
            ]
            half = len(own) // 2
            anchors.append(
                {
                    "checkpoint": row["name"],
                    "plans": list(_by_plan([*before, *own])),
                    "against_earlier": _differ(before, own),
                    "within": _differ(own[:half], own[half:]),
                }
            )
    return anchors


def _earlier(plan: Plan, row: dict[str, Any]) -> list[Plan]:
    """Return earlier plans with the same anchor, served in the same way, that are not blind any more."""
    visible = Q(state=PlanState.REVEALED) | Q(blind=False, state=PlanState.CLOSED)
    rows = Plan.objects.filter(visible, frozen_at__lt=plan.frozen_at).exclude(pk=plan.pk)
    served = _served(plan, row)
    return [
        earlier
        for earlier in rows.order_by("frozen_at", "pk")
        if any(
            _served(earlier, checkpoint) == served for checkpoint in (earlier.document or {})["checkpoints"]
        )
    ]


def _served(plan: Plan, row: dict[str, Any]) -> dict[str, Any]:
    """Return the properties of an anchor, a checkpoint that several plans share, on which its outcomes depend.

    Labels are excluded.
    """
    fields = {name: row.get(name) for name in ("name", "policy", "digest", "strategy")}
    document = plan.document or {}
    return {**fields, "of_plan": document.get("strategy"), "counts_as": document.get("counts_as")}


def _same_scenes(first: Plan, second: Plan) -> set[str]:
    """Return the names of scenes that are identical in both plans: texts, milestones and time limits."""
    first_scenes, second_scenes = (
        {scene["name"]: {**scene, "positions": None} for scene in (plan.document or {})["scenes"]}
        for plan in (first, second)
    )
    return {name for name, scene in first_scenes.items() if second_scenes.get(name) == scene}


def _tried(name: str, plan: Plan, scenes: set[str]) -> list[_Tried]:
    """Return the checkpoint's trials in these scenes that count, in order of allocation.

    If the plan is revealed, the trials have the scores that they had at the reveal.
    """
    return [
        _Tried(plan, (outcome.station, outcome.scene, outcome.position), outcome.success)
        for outcome in load_plan_outcomes(plan)
        if outcome.checkpoint == name and outcome.scene in scenes
    ]


def _by_plan(rows: Iterable[_Tried]) -> Iterator[dict[str, Any]]:
    tried: dict[Plan, list[bool]] = defaultdict(list)
    for trial in rows:
        tried[trial.plan].append(trial.success)
    for plan, outcomes in sorted(tried.items(), key=lambda row: row[0].frozen_at):
        yield {
            "plan": plan.name,
            "version": plan.version,
            "frozen_at": plan.frozen_at,
            "successes": sum(outcomes),
            "n": len(outcomes),
        }


def _differ(before: Sequence[_Tried], since: Sequence[_Tried]) -> float | None:
    """Return the exact two-sided p-value of a difference between the two groups of trials, stratified by condition.

    None if no condition has trials of both groups.
    """
    conditions = sorted({trial.condition for trial in (*before, *since)})
    tables = []
    for condition in conditions:
        sides = [
            [trial.success for trial in rows if trial.condition == condition] for rows in (before, since)
        ]
        (successes, n), (successes_since, m) = ((sum(side), len(side)) for side in sides)
        if n and m:
            tables.append(StratumTable(successes, n, successes_since, m))
    return exact_within(tables, least=1)
