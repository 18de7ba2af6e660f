"""Initial database rows of a lab, and of the demo."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from django.contrib.auth.models import User
from django.db import transaction

from evaweb.accounts.roles import Role, set_role
from evaweb.plans.frozen_document import checkpoint_of
from evaweb.plans.models import Allocation, Plan, PlanState, StoppingRule
from evaweb.plans.services import amend_plan, freeze_plan
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint, Milestone, Position, Scene
from runtime.benches.schema import load_schema

_ALPHABET = "abcdefghjkmnpqrstuvwxyz23456789"  # without characters that look alike


@dataclass(frozen=True, slots=True)
class DemoLogin:
    """Account with its new password."""

    username: str
    password: str


def fresh_password() -> str:
    """Return a password of fifteen characters in three groups, 74 bits."""
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(5)) for _ in range(3))


@transaction.atomic
def demo_login(*, username: str, role: Role) -> DemoLogin:
    """Create or update the account with a role and a new password."""
    user, _ = User.objects.get_or_create(username=username)
    password = fresh_password()
    user.set_password(password)
    user.is_active = True
    user.save()
    set_role(user=user, role=role)
    return DemoLogin(username, password)


def has_no_accounts() -> bool:
    """Return True if there is no active account."""
    return not User.objects.filter(is_active=True).exists()


def station_registered(*, name: str, robot: str, deployment: str, simulated: bool) -> Station:
    """Create or update the station of a deployment; its title and message are left to the administrator."""
    facts = {"robot": robot, "deployment": deployment, "simulated": simulated}
    station, _ = Station.objects.update_or_create(name=name, defaults=facts, create_defaults=facts)
    return station


@dataclass(frozen=True, slots=True)
class _Step:
    text: str
    points: int
    required: bool
    truth: str


_MILESTONES = (
    _Step("The gripper holds the block", 1, False, "grasped"),
    _Step("The block is lifted clear of the table", 1, False, "lifted"),
    _Step("The block is above the plate", 1, False, "over_plate"),
    _Step("The block rests on the plate, released", 2, True, "placed"),
)
_POSITIONS = (
    ("block left", [-0.14, 0.26, 0], [0.08, 0.34]),
    ("block right", [0.14, 0.26, 20], [-0.08, 0.34]),
    ("block far left", [-0.16, 0.36, -30], [0.05, 0.24]),
    ("block turned", [0.12, 0.32, 40], [-0.10, 0.26]),
)


@transaction.atomic
def demo_scene() -> Scene:
    """Return the tabletop scene, created once; changes by an administrator are kept."""
    scene, created = Scene.objects.get_or_create(
        name="block-on-plate",
        defaults={
            "title": "Block on plate",
            "instruction": "put the block on the plate",
            "criterion": "The block rests on the plate and the gripper has let go of it.",
            "layout": "The simulated bench lays itself out at set-up.",
            "time_limit_s": 40.0,
        },
    )
    if created:
        for number, (label, block, plate) in enumerate(_POSITIONS, start=1):
            bench = {"block": block, "plate": plate}
            Position.objects.create(scene=scene, number=number, label=label, bench=bench)
        for order, step in enumerate(_MILESTONES, start=1):
            Milestone.objects.create(
                scene=scene,
                order=order,
                text=step.text,
                points=step.points,
                required=step.required,
                truth=step.truth,
            )
    return scene


_PLAN_CHANGED = "the demo's policy servers listen elsewhere this time"


def demo_plan(
    *,
    name: str,
    title: str,
    question: str,
    owner: str,
    positions: Iterable[Position],
    checkpoints: Sequence[Checkpoint],
    repetitions: int,
    design: str = StoppingRule.EVIDENCE,  # type: ignore[assignment]
    order: str = Allocation.PAIRED,  # type: ignore[assignment]
) -> Plan:
    """Return a frozen blind plan that compares two checkpoints at all these positions.

    A plan with this name that exists already is returned instead, amended first if it is frozen and its checkpoints
    have changed since. If it is closed or revealed, it stays so.

    Raises:
        Conflict: If the existing plan cannot be amended, because some of its trials are not finished.
    """
    user = User.objects.get(username=owner)
    plan = Plan.objects.filter(name=name).order_by("-version").first()
    if plan is None:
        first, second = checkpoints
        plan = Plan.objects.create(
            name=name,
            title=title,
            question=question,
            owner=user,
            repetitions=repetitions,
            first=first,
            second=second,
            stopping=design,
            allocation=order,
        )
        plan.positions.set(positions)
        plan.checkpoints.set(checkpoints)
    if plan.state == PlanState.FROZEN:
        now = {row.name: checkpoint_of(row) for row in plan.checkpoints.all()}
        if now == {row["name"]: row for row in (plan.document or {})["checkpoints"]}:
            return plan
        plan = amend_plan(user=user, plan=plan, reason=_PLAN_CHANGED)
    return freeze_plan(user=user, plan=plan) if plan.state == PlanState.DRAFT else plan


def demo_checkpoint(*, name: str, description: str, policy: Mapping[str, object]) -> Checkpoint:
    """Create or update a checkpoint of the demo with the current address of its policy server."""
    facts = {"policy": dict(policy)}
    checkpoint, _ = Checkpoint.objects.update_or_create(
        name=name, defaults=facts, create_defaults={"description": description, **facts}
    )
    return checkpoint


@transaction.atomic
def benchmark_scene(*, bench: str, task: str, instruction: str, time_limit_s: float, **choices: str) -> Scene:
    """Return the scene of one task of a benchmark, created once; changes by an administrator are kept.

    It has one position, with its `task` and further `choices`; further layouts come from the seeds of a plan's
    repetitions. Its milestones are those of the bench; those that are the task's success are required.
    """
    schema = load_schema(bench)
    scene, created = Scene.objects.get_or_create(
        name=f"{bench}-{task}"[:60],
        defaults={
            "title": f"{schema.title}: {task}",
            "instruction": instruction,
            "criterion": " and ".join(schema.milestones[name].text for name in schema.success),
            "layout": "The simulated bench lays itself out at set-up.",
            "bench": bench,
            "time_limit_s": time_limit_s,
        },
    )
    if created:
        Position.objects.create(
            scene=scene, number=1, label=task, bench={"choices": {"task": task, **choices}}
        )
        for order, (name, milestone) in enumerate(schema.milestones.items(), start=1):
            Milestone.objects.create(
                scene=scene, order=order, text=milestone.text, required=name in schema.success, truth=name
            )
    return scene
