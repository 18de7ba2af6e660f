"""Rules of blind plans: which users may know the checkpoint of a trial.

Until the reveal every user is blind who has not unblinded the plan. Its owner and administrators may unblind it, a
recorded act, if they do not run its trials: a user who has been handed a trial cannot unblind, and an unblinded user
gets no trials. Thus even the only user of a lab can either run the trials or unblind, whichever comes first, but not
both.

If a plan is lost with the database, and its trials were restored from the disk, every user is blind.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from django.db import transaction
from django.db.models import Count, Q, QuerySet

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import (
    FULL_VISIBILITY,
    Visibility,
    plan_titles,
    register_visibility_rule,
)
from evaweb.core.errors import NotAllowed
from evaweb.episodes.reconcile import register_conclusion
from evaweb.plans.models import Handout, Look, Plan, PlanEvent, PlanState
from evaweb.plans.selectors import overlapping_plans
from evaweb.trials.models import Checkpoint, Evaluation, Trial
from evaweb.trials.selectors import UNFINISHED


def is_sealed_for(plan: Plan, user: Any) -> bool:
    """Return True if the plan is sealed for this user; asking this does not unblind."""
    return plan.sealed and not is_unblinded(plan, user)


@transaction.atomic
def record_unblinding(plan: Plan, user: Any) -> None:
    """Record that the user unblinds the plan. Raises: NotAllowed if they may not."""
    locked = Plan.objects.select_for_update(of=("self",)).select_related("owner").get(pk=plan.pk)
    if not locked.sealed:
        return
    reason = _why_not(locked, user)
    if reason:
        raise NotAllowed(reason)
    _, created = Look.objects.get_or_create(plan=locked, user=user)
    if created:
        PlanEvent.objects.create(
            plan=locked, by=user, what="looked", text="behind the blind, before the reveal"
        )


def is_unblinded(plan: Plan, user: Any) -> bool:
    """Return True if this user has unblinded the plan."""
    return Look.objects.filter(plan=plan, user=user).exists()


def has_looked_at_the_same(plan: Plan, user: Any) -> bool:
    """Return True if this user has unblinded any version of the plan, or a plan with the same checkpoints."""
    unblindings = Look.objects.filter(user=user)
    if not unblindings.exists():  # true for most users, and checked at every score
        return False
    overlapping = overlapping_plans(plan).values("pk")
    return unblindings.filter(Q(plan__name=plan.name) | Q(plan__in=overlapping)).exists()


def can_unblind(plan: Plan, user: Any) -> bool:
    """Return True if `record_unblinding` would succeed or is unnecessary."""
    return not plan.sealed or _why_not(plan, user) == ""


def visibility_for(user: Any) -> Visibility:
    """Return the user's Visibility under the current plans; see evaweb.blinding.visibility."""
    plans = Plan.objects.filter(blind=True, state__in=(PlanState.FROZEN, PlanState.CLOSED))
    if user.pk is not None:
        plans = plans.exclude(looks__user=user)
    # Include the frozen names: recordings keep the name that a checkpoint had.
    blind_rows = list(plans.values_list("pk", "title", "version", "document__checkpoints"))
    lost = list(_lost_plans().values_list("pk", "name", "version"))
    if not (blind_rows or lost):
        return FULL_VISIBILITY
    keys = [pk for pk, *_ in blind_rows]
    orphans = Trial.objects.filter(evaluation__in=[pk for pk, *_ in lost]).order_by()
    of_plans = Checkpoint.objects.filter(Q(plan__in=keys) | Q(pk__in=orphans.values("checkpoint")))
    hidden = dict(of_plans.values_list("pk", "name"))
    frozen = {row["name"] for *_, rows in blind_rows for row in rows or ()}
    handed = [
        *orphans.values_list("station__name", "status").distinct(),
        *Handout.objects.filter(plan__in=keys)
        .order_by()
        .values_list("trial__station__name", "trial__status")
        .distinct(),
    ]
    return Visibility(
        checkpoints=frozenset(hidden),
        names=frozenset({*hidden.values(), *frozen}),
        stations=frozenset(station for station, _ in handed),
        keys=frozenset(keys),
        busy_stations=frozenset(station for station, status in handed if status in UNFINISHED),
        plans=f"{plan_titles(f'{title} v{version}' for _, title, version, *_ in (*blind_rows, *lost))} is blind "
        "until it is revealed",
        user=user.pk,
    )


register_visibility_rule(visibility_for)


def _lost_plans() -> QuerySet[Evaluation]:
    """Return the evaluations of plans missing from the database; they count as blind, as nothing can unblind them."""
    return Evaluation.objects.filter(kind=Evaluation.Kind.PLAN, plan=None).exclude(trials=None).order_by("pk")


@register_conclusion
def lost_plan_notes() -> Iterator[str]:
    """Yield a message for each plan that is missing from the database although its trials exist."""
    for row in _lost_plans().annotate(number=Count("trials")):
        yield (
            f"{row.number} trials are of plan {row}, which is not in the database: what tells which checkpoint they "
            "were of stays hidden from everybody. Put a backup of the database back, or import the plan (plans import; "
            f"or write one named {row.name}), and freeze and reveal it as an administrator"
        )


def _why_not(plan: Plan, user: Any) -> str:
    if plan.owner_id != user.pk and role_of(user) is not Role.ADMIN:
        return f"{plan} is blind until its owner, {plan.owner.get_username()}, reveals it"
    if Trial.objects.filter(evaluation=plan.evaluation_id, operator=user).exists():
        return f"you have run trials of {plan}, which is blind: what they were of is shown after the reveal"
    return ""
