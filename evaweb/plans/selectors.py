"""Reads of plans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from django.db.models import Count, Q, QuerySet

from evaweb.errors import NotFound
from evaweb.plans.models import Handout, Plan, PlanState, Reference, Slot
from evaweb.roles import Role, role_of
from evaweb.stations.models import Station
from evaweb.trials.models import Trial, TrialStatus
from runtime.core.sentences import Pattern

_NO_SUCH_PLAN = Pattern(
    "plans.selectors.no_such_plan",
    "plan {name:.60}{value} does not exist; there are: {known}",
)
_NO_SUCH_REFERENCE = Pattern(
    "plans.selectors.no_such_reference",
    "reference picture {identity} does not exist",
)


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
        raise NotFound(_NO_SUCH_PLAN(name=name, value=f" v{version}" if version else "", known=known))
    return found


def plans_beside(plan: Plan) -> QuerySet[Plan]:
    """Other plans, by another name, that were frozen with two of its checkpoints or more: they tell of the same."""
    shared = Count("checkpoints", filter=Q(checkpoints__in=plan.checkpoints.values("pk")), distinct=True)
    rows = Plan.objects.exclude(name=plan.name).exclude(state=PlanState.DRAFT)
    return rows.annotate(shared=shared).filter(shared__gte=2).order_by("name", "version")


def plans_open(*, station: Station) -> list[Plan]:
    """Those of which trials are handed out at this station."""
    rows = Plan.objects.filter(state=PlanState.FROZEN).select_related("owner")
    return list(rows.filter(Q(stations=None) | Q(stations=station)).distinct().order_by("title", "-version"))


def remaining(plan: Plan, dropped: Mapping[str, int] | None = None) -> int:
    """Number of trials that a plan foresees and that do not count yet, without those of `dropped` checkpoints."""
    counted = plan.handouts.filter(trial__status=TrialStatus.SCORED).values("slot")
    return without_dropped(plan.slots.exclude(pk__in=counted), dropped or {}).count()


def without_dropped(slots: QuerySet[Slot], dropped: Mapping[str, int]) -> QuerySet[Slot]:
    """Slots but for those of checkpoints in blocks after which they are tried no more."""
    for name, at in dropped.items():
        slots = slots.exclude(checkpoint__name=name, block__gte=at)
    return slots


def handout_of(*, trial: Trial) -> Handout | None:
    """Handout of a trial, None for one of no plan."""
    return Handout.objects.select_related("plan", "slot").filter(trial=trial).first()


def reference_get(*, id: int) -> Reference:
    """That reference picture of a camera."""
    rows = Reference.objects.select_related("station", "position__scene", "by")
    found = rows.filter(pk=id).first() if 0 < id < 2**63 else None
    if found is None:
        raise NotFound(_NO_SUCH_REFERENCE(identity=id))
    return found
