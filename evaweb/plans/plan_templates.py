"""Plans that are made when a checkpoint is registered: as another plan, with the new checkpoint in place of one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from django.contrib.auth.models import User
from django.core.exceptions import ValidationError
from django.db import transaction
from django.db.models.signals import post_save
from django.dispatch import receiver

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict, EvaError, NotFound
from evaweb.jobs.models import Job
from evaweb.jobs.services import enqueue
from evaweb.plans.allocation import NothingLeft
from evaweb.plans.copies import jobs_at_work, request_trials
from evaweb.plans.models import Plan, PlanState, PlanTemplate, TemplateUse
from evaweb.plans.services import copy_design, freeze_plan
from evaweb.trials.models import Checkpoint
from runtime.core.sentences import Pattern

_NO_SUCH_TEMPLATE = Pattern(
    "plans.plan_templates.no_such_template", "template {name:.60} does not exist; there are: {known}"
)
_TEMPLATE_SWITCHED_OFF = Pattern(
    "plans.plan_templates.template_switched_off", "template {name} is switched off: ask an administrator"
)
_REGISTERED_OTHERWISE = Pattern(
    "plans.plan_templates.registered_otherwise",
    "checkpoint {name} is registered already, with another {fields}: give the new one another name",
)

KIND = "template"


def template_get(*, name: str) -> PlanTemplate:
    """Return the template with that name. Raises: NotFound, which lists the existing ones."""
    template = PlanTemplate.objects.select_related("plan__owner", "arm", "station").filter(name=name).first()
    if template is None:
        known = ", ".join(PlanTemplate.objects.values_list("name", flat=True)) or "none yet"
        raise NotFound(_NO_SUCH_TEMPLATE(name=name, known=known))
    return template


@transaction.atomic
def register_checkpoint(
    *, user: User, template: PlanTemplate, name: str, **facts: str
) -> tuple[Checkpoint, Job]:
    """Register a checkpoint as a program does at the end of a training run, and queue the job that makes its plan.

    The template says how its policy is reached. A repetition of the same registration changes nothing.

    Args:
        facts: Values of `description`, `digest`, `recipe` and `training_run`.

    Raises:
        EvaError: A value is invalid, or a checkpoint of that name is registered with other values.
    """
    require_role(user, Role.OPERATOR)
    if not template.active:
        raise Conflict(_TEMPLATE_SWITCHED_OFF(name=template.name))
    policy = template.policy_for({"name": name, "digest": facts.get("digest", "")})
    values: dict[str, Any] = {**facts, "policy": policy, "tags": [template.tag] if template.tag else []}
    values["training_run"] = values.get("training_run") or None
    found = Checkpoint.objects.filter(name=name).first()
    if found is not None:
        if differing := [key for key, value in values.items() if getattr(found, key) != value]:
            raise Conflict(_REGISTERED_OTHERWISE(name=name, fields=", ".join(differing)))
        return found, request_plan(template, found)
    checkpoint = Checkpoint(name=name, **values)
    try:
        checkpoint.full_clean()
    except ValidationError as invalid:
        field, messages = next(iter(invalid.message_dict.items()))
        raise EvaError(f"{field}: {'; '.join(messages)}") from None
    checkpoint.save()
    return checkpoint, request_plan(template, checkpoint)


def request_plan(template: PlanTemplate, checkpoint: Checkpoint) -> Job:
    """Queue the job that makes, freezes and starts the checkpoint's plan."""
    args = {"template": template.pk, "checkpoint": checkpoint.pk}
    return enqueue(kind=KIND, key=f"{KIND}:{template.pk}:{checkpoint.pk}", args=args)


@receiver(post_save, sender=Checkpoint)
def _on_registered(sender: object, instance: Checkpoint, created: bool, **kwargs: Any) -> None:
    if created:
        for template in PlanTemplate.objects.filter(active=True).exclude(tag=""):
            if template.tag in instance.tags:
                request_plan(template, instance)


def start_plan(template: PlanTemplate, checkpoint: Checkpoint) -> Mapping[str, Any]:
    """Make the checkpoint's plan, freeze it and start its trials at copies of the template's station.

    What has been done before is not done again. The plan belongs to the owner of the template's plan.

    Returns:
        `plan`, its name, and `trials`, how many are left.

    Raises:
        EvaError: The plan cannot be frozen, or its trials cannot be carried out at copies.
    """
    plan = plan_for(template, checkpoint)
    if plan.state == PlanState.DRAFT:
        plan = freeze_plan(user=plan.owner, plan=plan)
    if template.station is not None and plan.state == PlanState.FROZEN and not jobs_at_work(plan):
        try:
            request_trials(user=plan.owner, plan=plan, station=template.station, count=template.copies)
        except NothingLeft as why:
            return {"plan": plan.name, "ended": str(why)}
    return {"plan": plan.name}


@transaction.atomic
def plan_for(template: PlanTemplate, checkpoint: Checkpoint) -> Plan:
    """Return the plan of the checkpoint by this template; draft it if there is none."""
    locked = PlanTemplate.objects.select_for_update().get(pk=template.pk)
    use = (
        TemplateUse.objects.select_related("plan__owner")
        .filter(template=locked, checkpoint=checkpoint)
        .first()
    )
    if use is not None:
        return use.plan
    title = f"{locked.title or locked.plan.title} {locked.uses.count() + 1}"
    plan = copy_design(plan=locked.plan, title=title, replaced={locked.arm_id: checkpoint})
    TemplateUse.objects.create(template=locked, checkpoint=checkpoint, plan=plan)
    return plan
