"""Reads of plans."""

from __future__ import annotations

from typing import Any

from django.db.models import Q, QuerySet

from evaweb.errors import NotFound
from evaweb.plans.models import Handout, Plan, PlanState, Reference
from evaweb.roles import Role, role_of
from evaweb.stations.models import Station
from evaweb.trials.models import Trial, TrialStatus


def plan_list(*, user: Any) -> QuerySet[Plan]:
    """All versions of all plans; drafts are their owners' and administrators', for they name checkpoints."""
    rows = Plan.objects.select_related("owner", "first", "second").prefetch_related("stations")
    if role_of(user) is Role.ADMIN:
        return rows
    return rows.filter(~Q(state=PlanState.DRAFT) | Q(owner=user))


def plan_get(*, name: str, version: int | None = None, user: Any) -> Plan:
    """That version, or the newest that is no draft; NotFound lists what there is."""
    rows = plan_list(user=user).filter(name=name).order_by("-version")
    frozen = rows.exclude(state=PlanState.DRAFT)
    found = rows.filter(version=version).first() if version is not None else frozen.first() or rows.first()
    if found is None:
        known = ", ".join(sorted(set(plan_list(user=user).values_list("name", flat=True)))) or "none yet"
        raise NotFound(
            f"plan {name:.60}{f' v{version}' if version else ''} does not exist; there are: {known}"
        )
    return found


def plans_open(*, station: Station) -> list[Plan]:
    """Those of which trials are handed out at this station."""
    rows = Plan.objects.filter(state=PlanState.FROZEN).select_related("owner")
    return list(rows.filter(Q(stations=None) | Q(stations=station)).distinct().order_by("title", "-version"))


def remaining(plan: Plan) -> int:
    """Number of trials that a plan foresees and that do not count yet."""
    counted = plan.handouts.filter(trial__status=TrialStatus.SCORED).values("slot")
    return plan.slots.exclude(pk__in=counted).count()


def handout_of(*, trial: Trial) -> Handout | None:
    """Handout of a trial, None for one of no plan."""
    return Handout.objects.select_related("plan", "slot").filter(trial=trial).first()


def reference_get(*, id: int) -> Reference:
    """That reference picture of a camera."""
    rows = Reference.objects.select_related("station", "position__scene", "by")
    found = rows.filter(pk=id).first() if 0 < id < 2**63 else None
    if found is None:
        raise NotFound(f"reference picture {id} does not exist")
    return found
