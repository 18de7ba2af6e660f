"""Queries on plans."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import Any

from django.db.models import Q, QuerySet

from evaweb.accounts.roles import Role, role_of
from evaweb.core.errors import NotFound
from evaweb.plans.models import Handout, Plan, PlanState, Reference, Slot
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
    """Return all versions of all plans; drafts only for their owners and administrators, as they name checkpoints."""
    rows = Plan.objects.select_related("owner", "first", "second").prefetch_related("stations")
    if role_of(user) is Role.ADMIN:
        return rows
    return rows.filter(~Q(state=PlanState.DRAFT) | Q(owner=user))


def plan_get(*, name: str, version: int | None = None, user: Any) -> Plan:
    """Return version `version` of the plan, or its newest version that is not a draft.

    Raises: NotFound, which lists the existing plans.
    """
    rows = plan_list(user=user).filter(name=name).order_by("-version")
    frozen = rows.exclude(state=PlanState.DRAFT)
    plan = rows.filter(version=version).first() if version is not None else frozen.first() or rows.first()
    if plan is None:
        names = ", ".join(sorted(set(plan_list(user=user).values_list("name", flat=True)))) or "none yet"
        raise NotFound(_NO_SUCH_PLAN(name=name, value=f" v{version}" if version else "", known=names))
    return plan


def overlapping_plans(plan: Plan) -> QuerySet[Plan]:
    """Return frozen plans with another name that share at least two checkpoints with `plan`.

    The results of such a plan reveal the same as those of `plan`. A copy of a checkpoint counts as the same checkpoint:
    equal weights (or, without digest, the same server) and strategy.
    """
    rows = Checkpoint.objects.values_list("pk", "digest", "policy", "strategy")
    label_of = {
        pk: json.dumps([weights or policy, strategy], sort_keys=True)
        for pk, weights, policy, strategy in rows
    }
    mine = Counter(label_of[pk] for pk in plan.checkpoints.values_list("pk", flat=True))
    frozen = Plan.objects.exclude(name=plan.name).exclude(state=PlanState.DRAFT)
    by_plan: dict[int, Counter[str]] = defaultdict(Counter)
    for plan_key, checkpoint in frozen.values_list("pk", "checkpoints"):
        if checkpoint is not None:
            by_plan[plan_key][label_of[checkpoint]] += 1
    same = [plan_key for plan_key, arms in by_plan.items() if (arms & mine).total() >= 2]
    return frozen.filter(pk__in=same).order_by("name", "version")


def plans_open(*, station: Station) -> list[Plan]:
    """Return the plans whose trials can be handed out at this station."""
    rows = Plan.objects.filter(state=PlanState.FROZEN).select_related("owner")
    return list(rows.filter(Q(stations=None) | Q(stations=station)).distinct().order_by("title", "-version"))


def remaining(plan: Plan, dropped: Mapping[str, int] | None = None) -> int:
    """Return the number of slots that have no scored trial yet, except the slots of `dropped` checkpoints."""
    counted = plan.handouts.filter(trial__status=TrialStatus.SCORED).values("slot")
    return without_dropped(plan.slots.exclude(pk__in=counted), dropped or {}).count()


def needed_handouts(plan: Plan) -> QuerySet[Handout]:
    """Return the handouts of a plan, except of trials that were begun beside the one with which its design ended."""
    return plan.handouts.exclude(trial__status=TrialStatus.NOT_NEEDED)


def without_dropped(slots: QuerySet[Slot], dropped: Mapping[str, int]) -> QuerySet[Slot]:
    """Exclude the slots of each dropped checkpoint, from the block on at which it was dropped."""
    for name, at in dropped.items():
        slots = slots.exclude(checkpoint__name=name, block__gte=at)
    return slots


def handout_of(*, trial: Trial) -> Handout | None:
    """Return the handout of a trial, None for a trial outside any plan."""
    return Handout.objects.select_related("plan", "slot").filter(trial=trial).first()


def reference_get(*, id: int) -> Reference:
    """Return the reference picture with that id. Raises: NotFound."""
    rows = Reference.objects.select_related("station", "position__scene", "by")
    reference = rows.filter(pk=id).first() if 0 < id < 2**63 else None
    if reference is None:
        raise NotFound(_NO_SUCH_REFERENCE(identity=id))
    return reference
