"""Actions on plans: freeze, amend, close, reveal."""

from __future__ import annotations

from typing import Any

from django.contrib.auth.models import User
from django.db import transaction
from django.db.models import QuerySet
from django.utils import timezone

from evaweb.errors import Conflict, EvaError, NotAllowed
from evaweb.plans import commitment as blinding
from evaweb.plans import reveals
from evaweb.plans.canonical import difference, digest
from evaweb.plans.design import at_the_reveal, conclusion_of, drafted, ended_because
from evaweb.plans.documents import document_of, units_of
from evaweb.plans.models import Plan, PlanEvent, PlanState, PrimaryOutcome, Slot, StoppingRule
from evaweb.plans.schedule import Unit
from evaweb.plans.seeded_draws import new_key
from evaweb.plans.selectors import handout_of, remaining
from evaweb.roles import Role, require, role_of
from evaweb.trials.lifecycle import OPEN
from evaweb.trials.models import Evaluation, Trial, TrialStatus
from evaweb.trials.services import declare_settled
from evaweb.trials.voids import voids_lapse

_COPIED = (
    "name",
    "title",
    "question",
    "repetitions",
    "strategy",
    "blind",
    "stopping",
    "outcome",
    "margin",
    "look_after",
    "alpha",
    "second_rater_share",
    "match_gate",
)


def plan_freeze(*, user: User, plan: Plan) -> Plan:
    """Make a draft a document that never changes, with its schedule and commitment; trials can be handed out then.

    Where the database was lost and trials of such a plan came back from the disk, they are its own, and it is closed at
    once: their schedule and codes are gone. Administrators alone.
    """
    _require_owner(plan, user)
    if plan.state == PlanState.DRAFT:
        _check(plan)  # before anything is locked: a boundary takes seconds, and is then known
    return _frozen(user, plan)


@transaction.atomic
def _frozen(user: User, plan: Plan) -> Plan:
    held = _held(plan)
    _require_owner(held, user)
    if held.state != PlanState.DRAFT:
        raise Conflict(f"{held} is {held.get_state_display()}: only a draft is frozen; amend it instead")
    _check(held)
    document = document_of(held)
    held.document, held.digest, held.key = document, digest(document), new_key()
    units = units_of(held)
    held.commitment = blinding.commitment(held.digest, units, bytes(held.key))
    held.evaluation, new = Evaluation.objects.get_or_create(
        name=held.name,
        version=held.version,
        defaults={"kind": Evaluation.Kind.PLAN, "description": held.title},
    )
    if not new:
        require(user, Role.ADMIN)  # with it trials can be revealed of a plan that may have been another one's
    held.state, held.frozen_at = PlanState.FROZEN, timezone.now()
    held.save()
    _lay_out(held, units)
    changes = difference(held.amends.document or {}, document) if held.amends else []
    told = f"digest {held.digest}, {len(units)} trials, commitment {held.commitment}"
    _note(held, user, "frozen", "\n".join([told, *changes]))
    if held.amends and held.amends.state == PlanState.FROZEN:
        _close(held.amends, user, f"amended by version {held.version}: {held.amended_because}")
    if not new:
        _close(held, user, "its trials were made before the database was lost: amend it to make more")
    plan.refresh_from_db()
    return plan


@transaction.atomic
def plan_amend(*, user: User, plan: Plan, reason: str) -> Plan:
    """A draft of the next version, as the frozen one is now; that one goes on until the new one is frozen."""
    held = _held(plan)
    _require_owner(held, user)
    why = _reason(reason, "a plan is amended")
    if held.state == PlanState.DRAFT:
        raise Conflict(f"{held} is a draft: edit it")
    if held.state == PlanState.REVEALED:
        raise Conflict(
            f"{held} was revealed: what is changed now would be changed with the result in view; make another plan"
        )
    if hasattr(held, "amendment"):
        raise Conflict(f"{held} is amended by version {held.amendment.version} already")
    made = Plan.objects.create(
        **{name: getattr(held, name) for name in _COPIED},
        version=held.version + 1,
        owner=held.owner,
        first=held.first,
        second=held.second,
        amends=held,
        amended_because=why,
    )
    for name in ("positions", "checkpoints", "stations"):
        getattr(made, name).set(getattr(held, name).all())
    _note(held, user, "amended", f"version {made.version} is being drafted: {why}")
    return made


@transaction.atomic
def plan_close(*, user: User, plan: Plan, reason: str) -> Plan:
    """Hand out no more trials. What is prepared, running or not yet scored is finished first."""
    held = _held(plan)
    _require_owner(held, user)
    why = _reason(reason, "a plan is closed")
    if held.state != PlanState.FROZEN:
        raise Conflict(f"{held} is {held.get_state_display()}: only a running plan is closed")
    _close(held, user, why)
    plan.refresh_from_db()
    return plan


@transaction.atomic
def plan_reveal(*, user: User, plan: Plan) -> Plan:
    """Say which checkpoint was which, once and for all, and with it the key of the commitment."""
    held = _held(plan)
    _require_owner(held, user)
    if held.state != PlanState.CLOSED:
        raise Conflict(f"{held} is {held.get_state_display()}: it is closed first, then revealed")
    units = units_of(held)
    if not blinding.verified(digest(held.document or {}), units, bytes(held.key or b""), held.commitment):
        raise EvaError(
            f"{held}: document, schedule and key are not those of the commitment {held.commitment}: "
            "somebody has changed the database; nothing was revealed"
        )
    if _slots(held) != [unit.row for unit in units]:
        raise EvaError(
            f"{held}: scenes, positions and checkpoints of its schedule are not called what they were when it was "
            "frozen: call them so again; nothing was revealed"
        )
    voids_lapse(_trials(held), user=user, now=True)
    before = reveals.kept(held)
    held.at_reveal = before.at_reveal if before else at_the_reveal(held)
    held.state, held.revealed_at, held.revealed_by = PlanState.REVEALED, timezone.now(), user
    again = (
        f"; what counts is that of the reveal of {before.at:%Y-%m-%d %H:%M} UTC by {before.by}"
        if before
        else ""
    )
    if before is None:
        reveals.keep(held)
    held.save()
    _note(held, user, "revealed", f"key {bytes(held.key or b'').hex()}; commitment verified{again}")
    plan.refresh_from_db()
    return plan


@transaction.atomic
def plan_end(*, user: User, plan: Plan, asked: bool = False) -> None:
    """Close a running plan whose design has ended, as soon as none of its trials is unfinished.

    With trials left, a boundary that was crossed ends it where the next one is `asked` for: a score that was mistyped
    can be corrected until then, and corrected to and fro it does not tell at once which trial is of which checkpoint.
    The reason says that a boundary was crossed or that all pairs are made: never for which checkpoint.
    """
    held = _held(plan)
    found = conclusion_of(held) if held.state == PlanState.FROZEN else None
    if found is None or not found.ended or _unfinished(held):
        return
    if not remaining(held) or (asked and found.ended == "boundary"):
        _close(held, user, ended_because(found))


def _looked_at(trial: Trial, user: User) -> None:
    handout = handout_of(trial=trial)
    if handout is not None:
        plan_end(user=user, plan=handout.plan)


declare_settled(_looked_at)


def _trials(plan: Plan) -> QuerySet[Trial]:
    return Trial.objects.filter(handout__plan=plan)


def _unfinished(plan: Plan) -> list[Trial]:
    return list(
        Trial.objects.filter(
            handout__plan=plan, status__in=(*OPEN, TrialStatus.ENDED), verdict=None
        ).select_related("handout", "station")
    )


def _close(plan: Plan, user: User, why: str) -> None:
    unfinished = _unfinished(plan)
    if unfinished:
        trial = unfinished[0]
        raise Conflict(
            f"{len(unfinished)} trials of {plan} are not finished, {trial.handout.code} on {trial.station.name} "
            f"is {trial.get_status_display()}: score or abandon them first"
        )
    plan.state, plan.closed_at, plan.closed_because = PlanState.CLOSED, timezone.now(), why
    plan.save()
    _note(plan, user, "closed", why)


def _check(plan: Plan) -> None:
    """Check a plan before it is frozen; EvaError says what is missing."""
    chosen = set(plan.checkpoints.values_list("pk", flat=True))
    if not plan.positions.exists():
        raise EvaError(f"{plan} has no position: choose initial conditions")
    if not chosen:
        raise EvaError(f"{plan} has no checkpoint: choose at least one")
    off = plan.checkpoints.filter(active=False).first() or None
    if off is not None:
        raise EvaError(f"checkpoint {off} is switched off")
    compared = [row for row in (plan.first, plan.second) if row]
    if len(compared) == 1 or (compared and compared[0] == compared[1]):
        raise EvaError("the comparison needs two checkpoints, or none")
    for row in compared:
        if row.pk not in chosen:
            raise EvaError(f"the comparison is about {row}, which is none of the plan's checkpoints")
    asked = (
        plan.stopping != StoppingRule.NONE
        or plan.margin is not None
        or plan.outcome != PrimaryOutcome.SUCCESS
    )
    if asked and not compared:
        raise EvaError("a design with looks, a margin or a score needs the comparison that it is about")
    drafted(plan)


def _slots(plan: Plan) -> list[list[Any]]:
    """The schedule as the database has it, as `Unit.row` says it."""
    named = ("index", "block", "checkpoint__name", "scene__name", "position__number", "repetition")
    return [list(row) for row in plan.slots.order_by("index").values_list(*named)]


def _lay_out(plan: Plan, units: list[Unit]) -> None:
    checkpoints = {row.name: row for row in plan.checkpoints.all()}
    positions = {(p.scene.name, p.number): p for p in plan.positions.select_related("scene")}
    Slot.objects.bulk_create(
        [
            Slot(
                plan=plan,
                index=unit.index,
                block=unit.block,
                checkpoint=checkpoints[unit.checkpoint],
                scene=positions[unit.condition.scene, unit.condition.position].scene,
                position=positions[unit.condition.scene, unit.condition.position],
                repetition=unit.repetition,
            )
            for unit in units
        ],
        batch_size=500,
    )


def _held(plan: Plan) -> Plan:
    return Plan.objects.select_for_update(of=("self",)).select_related("owner").get(pk=plan.pk)


def _require_owner(plan: Plan, user: User) -> None:
    require(user, Role.OPERATOR)
    if plan.owner_id != user.pk and role_of(user) is not Role.ADMIN:
        raise NotAllowed(f"{plan} is {plan.owner.get_username()}'s: ask them, or an administrator")


def _note(plan: Plan, user: User, what: str, text: str) -> None:
    PlanEvent.objects.create(plan=plan, by=user, what=what, text=text)


def _reason(given: str, when: str) -> str:
    why = given.strip()
    if not why:
        raise EvaError(f"reason is empty: {when} only with a reason that others can read")
    return why
