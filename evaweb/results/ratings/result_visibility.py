"""Visibility of a plan's results for a user: the single place that decides it."""

from __future__ import annotations

from typing import Any

from evaweb.blinding.visibility import Visibility, plan_titles, visibility_for_user
from evaweb.core.errors import NotAllowed
from evaweb.plans.blinding_rules import is_sealed_for
from evaweb.plans.models import Plan, PlanState


def sealed_reason(plan: Plan, user: Any, sight: Visibility | None = None) -> str:
    """Return why this user may see no results of the plan, "" if they may."""
    if is_sealed_for(plan, user):
        return f"{plan} is blind until it is revealed"
    plans = sealing_plans(plan, user, sight)
    if not plans:
        return ""
    names = plan_titles(plans)
    which = names if len(plans) == 1 else f"one or more of {names}"
    return f"checkpoints of {plan} are compared blind in {which}: what it found is shown after that reveal"


def sealing_plans(plan: Plan, user: Any, sight: Visibility | None = None) -> list[Plan]:
    """Return other plans, blind for this user, because of which the results of this plan are hidden.

    [] if they are visible. All blind plans are returned, not only those that share a checkpoint: a selection would
    reveal what they compare.
    """
    visibility = sight or visibility_for_user(user)
    if is_sealed_for(plan, user) or not plan.checkpoints.filter(pk__in=visibility.checkpoints).exists():
        return []
    return list(
        Plan.objects.filter(pk__in=visibility.keys).select_related("owner").order_by("title", "-version")
    )


def require_visible_results(plan: Plan, user: Any) -> None:
    """Raise NotAllowed if the user may not see results of the plan."""
    reason = sealed_reason(plan, user)
    if reason:
        raise NotAllowed(reason)


def has_results(plan: Plan) -> bool:
    """Return True if the plan may have trials."""
    return plan.state != PlanState.DRAFT
