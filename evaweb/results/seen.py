"""Whether somebody sees what a plan found: the one place that all results ask."""

from __future__ import annotations

from typing import Any

from evaweb.errors import NotAllowed
from evaweb.plans.models import Plan, PlanState
from evaweb.plans.sight import sealed_for
from evaweb.sight import Sight, sight_of


def why_sealed(plan: Plan, user: Any, sight: Sight | None = None) -> str:
    """Why this user sees no result of the plan, "" where they do."""
    if sealed_for(plan, user):
        return f"{plan} is blind until it is revealed"
    hidden = (sight or sight_of(user)).checkpoints
    if hidden and plan.checkpoints.filter(pk__in=hidden).exists():
        return f"checkpoints of {plan} are compared blind in another plan: what it found is shown after that reveal"
    return ""


def require_seen(plan: Plan, user: Any) -> None:
    """NotAllowed where the user is not to see results of the plan, or where there cannot be any."""
    why = why_sealed(plan, user)
    if why:
        raise NotAllowed(why)


def has_results(plan: Plan) -> bool:
    """Whether trials of it can have been made at all."""
    return plan.state != PlanState.DRAFT
