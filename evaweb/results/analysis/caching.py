"""Cache of analyses, in each web process, until their data change.

There is no invalidation: cached values carry a fingerprint of their rows, which is queried for each request. Scores,
corrections and voids change it, and so do names of checkpoints and scenes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from django.db.models import Count, Max, Q, Sum

from evaweb.core.fingerprint_cache import FingerprintCache, rounded_sum
from evaweb.plans.design import compared, findings_of, frozen_design, planned
from evaweb.plans.models import Allocation, Plan
from evaweb.results.analysis.analysis import Analysis, analyse
from evaweb.results.analysis.comparison import Verdict
from evaweb.results.analysis.filters import TrialFilter
from evaweb.results.analysis.load_outcomes import load_plan_interruptions, load_plan_outcomes
from evaweb.results.analysis.outcomes import Interruption, Outcome, by_checkpoint
from evaweb.statistics.designs import ANYTIME
from evaweb.statistics.proportions import Proportion, proportion
from evaweb.trials.models import Scene, Trial, TrialStatus


@dataclass(frozen=True, slots=True)
class Runs:
    """Runs of a plan: the trials that count, and the interrupted ones."""

    outcomes: list[Outcome]
    interruptions: list[Interruption]


_runs: FingerprintCache[Runs] = FingerprintCache()
_corrected: FingerprintCache[list[Outcome]] = FingerprintCache()
_analyses: FingerprintCache[Analysis] = FingerprintCache()
_pages: FingerprintCache[dict[str, Any]] = FingerprintCache()


def fingerprint(plan: Plan) -> Hashable:
    """Return a value that changes with every change of the data from which the plan is analysed."""
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
    """Return all runs of the plan; pass its fingerprint as `at` if it is known."""
    now = at or fingerprint(plan)
    return _runs.get(
        (plan.pk, plan.digest), now, lambda: Runs(load_plan_outcomes(plan), load_plan_interruptions(plan))
    )


def corrected_of(plan: Plan, only: TrialFilter, at: Hashable = None) -> dict[str, Proportion]:
    """Return, by name, the current successes of each checkpoint with scores corrected since the reveal.

    Only trials that the filter `only` selects count. {} for a plan that is not revealed.
    """
    if not plan.at_reveal:
        return {}
    at = at or fingerprint(plan)
    now = _corrected.get((plan.pk, plan.digest), at, lambda: load_plan_outcomes(plan, corrected=True))
    rates = {}
    before = by_checkpoint(only.apply(cached_runs(plan, at).outcomes))
    for name, rows in by_checkpoint(only.apply(now)).items():
        if [(o.trial, o.success, o.score) for o in rows] != [
            (o.trial, o.success, o.score) for o in before.get(name, [])
        ]:
            rates[name] = proportion(sum(o.success for o in rows), len(rows))
    return rates


def cached_analysis(plan: Plan, only: TrialFilter | None = None, at: Hashable = None) -> Analysis:
    """Return the analysis of the plan's trials, or of those that the filter selects."""
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
    """Return the training recipe of each checkpoint that is a separate training run.

    Checkpoints that are the same weights, served in several ways, are left out, because they are not separate runs.
    """
    rows = (plan.document or {}).get("checkpoints", ())
    weights = Counter(row["digest"] for row in rows if row.get("digest"))
    return {
        row["name"]: row["recipe"]
        for row in rows
        if row.get("recipe") and not row.get("strategy") and weights[row.get("digest")] <= 1
    }


def verdicts_of(plan: Plan) -> dict[tuple[str, str], Verdict]:
    """Return the design's verdict on each comparison of a plan; those of a draft are open."""
    results, design = findings_of(plan), frozen_design(plan.document) if plan.document else None
    if results is None or design is None:
        return dict.fromkeys(planned(plan), Verdict())
    own = design.outcome if design.rule == ANYTIME else ""
    return {
        names: Verdict(
            bool(conclusion.ended),
            conclusion.winner is not None if conclusion.ended and design.margin is None else None,
            own,
        )
        for names, conclusion in zip(compared(plan.document or {}), results.each, strict=True)
    }


def limits_of(plan: Plan) -> dict[str, float]:
    """Return the time limits [s] of the frozen plan's scenes, for those that have one."""
    scenes = (plan.document or {}).get("scenes", [])
    return {scene["name"]: scene["time_limit_s"] for scene in scenes if scene["time_limit_s"] is not None}


def cached_page(
    plan: Plan, name: Hashable, at: Hashable, make: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """Return the contents of one of the plan's pages, with its figures, from the cache; `make` builds them if needed.

    `name` identifies the page and the choices of its user. `at` is the current fingerprint of the plan: contents that
    were built at another fingerprint are not used.
    """
    return _pages.get((plan.pk, plan.digest, name), at, make)


def clear_caches() -> None:
    """Clear all caches."""
    _runs.clear()
    _corrected.clear()
    _analyses.clear()
    _pages.clear()
