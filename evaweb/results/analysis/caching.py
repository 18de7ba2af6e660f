"""Analyses that are kept as long as nothing they were made from has changed, in each process of the web.

Nothing is invalidated: what is kept carries a fingerprint of its rows, which is asked for again each time. A
score, a correction or a void changes it, and so does the name of a checkpoint or of a scene.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from django.db.models import Count, Max, Q, Sum

from evaweb.memo import FingerprintCache, rounded_sum
from evaweb.plans.design import compared, findings_of, frozen_design, planned
from evaweb.plans.models import Allocation, Plan
from evaweb.results.analysis.analysis import Analysis, Verdict, analyse
from evaweb.results.analysis.filters import TrialFilter
from evaweb.results.analysis.load_outcomes import load_plan_interruptions, load_plan_outcomes
from evaweb.results.analysis.outcomes import Interruption, Outcome, by_checkpoint
from evaweb.statistics.designs import ANYTIME
from evaweb.statistics.proportions import Proportion, proportion
from evaweb.trials.models import Scene, Trial, TrialStatus


@dataclass(frozen=True, slots=True)
class Runs:
    """Runs of a plan: the trials that count, and those that were broken off."""

    outcomes: list[Outcome]
    interruptions: list[Interruption]


_runs: FingerprintCache[Runs] = FingerprintCache()
_corrected: FingerprintCache[list[Outcome]] = FingerprintCache()
_analyses: FingerprintCache[Analysis] = FingerprintCache()
_pages: FingerprintCache[dict[str, Any]] = FingerprintCache()


def fingerprint(plan: Plan) -> Hashable:
    """Changes whenever an analysis of the plan would."""
    trials = Trial.objects.filter(evaluation=plan.evaluation_id)
    counted: dict[str, Any] = trials.aggregate(
        n=Count("pk"),
        scored=Count("pk", filter=Q(status=TrialStatus.SCORED)),
        broken=Count("pk", filter=Q(status=TrialStatus.INTERRUPTED)),
        verdicts=Sum("verdict_id", filter=Q(status=TrialStatus.SCORED)),
        newest=Max("verdict_id"),
        seconds=Sum("duration_s"),
        measured=Count("episode__smoothness"),
        changed=Max("changed_at"),
    )
    counted["seconds"] = rounded_sum(counted["seconds"])
    names = plan.checkpoints.order_by("pk").values_list("pk", "name")
    scenes = Scene.objects.filter(positions__plan=plan.pk).order_by("pk").distinct().values_list("pk", "name")
    return (plan.state, *counted.values(), *names, *scenes)


def cached_runs(plan: Plan, at: Hashable = None) -> Runs:
    """All runs of the plan; `at` is its fingerprint where that is known already."""
    now = at or fingerprint(plan)
    return _runs.get(
        (plan.pk, plan.digest), now, lambda: Runs(load_plan_outcomes(plan), load_plan_interruptions(plan))
    )


def corrected_of(plan: Plan, only: TrialFilter) -> dict[str, Proportion]:
    """Successes by checkpoint with the scores of now, where those of a revealed plan were corrected since."""
    if not plan.at_reveal:
        return {}
    at = fingerprint(plan)
    now = _corrected.get((plan.pk, plan.digest), at, lambda: load_plan_outcomes(plan, corrected=True))
    found = {}
    before = by_checkpoint(only.apply(cached_runs(plan, at).outcomes))
    for name, rows in by_checkpoint(only.apply(now)).items():
        if [(o.trial, o.success, o.score) for o in rows] != [
            (o.trial, o.success, o.score) for o in before.get(name, [])
        ]:
            found[name] = proportion(sum(o.success for o in rows), len(rows))
    return found


def cached_analysis(plan: Plan, only: TrialFilter | None = None, at: Hashable = None) -> Analysis:
    """Analysis of the plan's trials, or of those that are chosen."""
    now = at or fingerprint(plan)
    runs, which = cached_runs(plan, now), only or TrialFilter()

    def make() -> Analysis:
        return analyse(
            which.apply(runs.outcomes),
            which.apply(runs.interruptions),
            alpha=plan.alpha,
            planned=verdicts_of(plan),
            in_pairs=plan.allocation == Allocation.PAIRED,
            limits=limits_of(plan),
            checkpoints=[row["name"] for row in (plan.document or {}).get("checkpoints", ())],
            whole=which == TrialFilter(),
            recipes=recipes_of(plan),
        )

    return _analyses.get((plan.pk, plan.digest, which), now, make)


def recipes_of(plan: Plan) -> dict[str, str]:
    """Of each training run of a recipe which one; the same weights served in several ways are no runs of it."""
    rows = (plan.document or {}).get("checkpoints", ())
    weights = Counter(row["digest"] for row in rows if row.get("digest"))
    return {
        row["name"]: row["recipe"]
        for row in rows
        if row.get("recipe") and not row.get("strategy") and weights[row.get("digest")] <= 1
    }


def verdicts_of(plan: Plan) -> dict[tuple[str, str], Verdict]:
    """What its design says of each comparison of a plan; those of a draft are open."""
    found, design = findings_of(plan), frozen_design(plan.document) if plan.document else None
    if found is None or design is None:
        return dict.fromkeys(planned(plan), Verdict())
    own = design.outcome if design.rule == ANYTIME else ""
    return {
        names: Verdict(
            bool(one.ended),
            one.winner is not None if one.ended and design.margin is None else None,
            own,
        )
        for names, one in zip(compared(plan.document or {}), found.each, strict=True)
    }


def limits_of(plan: Plan) -> dict[str, float]:
    """Time limits [s] of the frozen plan's scenes, of those that have one."""
    scenes = (plan.document or {}).get("scenes", [])
    return {scene["name"]: scene["time_limit_s"] for scene in scenes if scene["time_limit_s"] is not None}


def cached_page(
    plan: Plan, name: Hashable, at: Hashable, make: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """Contents of the plan's page of that name, figures included."""
    return _pages.get((plan.pk, plan.digest, name), at, make)


def clear_caches() -> None:
    """Drop what is kept: the next callers wait for it to be made."""
    _runs.clear()
    _corrected.clear()
    _analyses.clear()
    _pages.clear()
