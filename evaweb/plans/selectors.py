"""Reads of plans."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import Any

from django.db.models import Q, QuerySet

from evaweb.errors import NotFound
from evaweb.plans.models import Handout, Plan, PlanState, Reference, Slot
from evaweb.roles import Role, role_of
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint, Trial, TrialStatus
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
    """Other plans, by another name, that were frozen with two of its checkpoints or more: they tell of the same.

    A copy of a checkpoint is the same: of the same weights, or else asked at the same server, served in the same way.
    """
    rows = Checkpoint.objects.values_list("pk", "digest", "policy", "strategy")
    what = {
        pk: json.dumps([weights or policy, strategy], sort_keys=True)
        for pk, weights, policy, strategy in rows
    }
    mine = Counter(what[pk] for pk in plan.checkpoints.values_list("pk", flat=True))
    frozen = Plan.objects.exclude(name=plan.name).exclude(state=PlanState.DRAFT)
    theirs: dict[int, Counter[str]] = defaultdict(Counter)
    for other, checkpoint in frozen.values_list("pk", "checkpoints"):
        if checkpoint is not None:
            theirs[other][what[checkpoint]] += 1
    same = [other for other, arms in theirs.items() if (arms & mine).total() >= 2]
    return frozen.filter(pk__in=same).order_by("name", "version")


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
