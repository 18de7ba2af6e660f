"""Services for plans: draft, edit, freeze, amend, close, reveal."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from django.contrib.admin.models import ADDITION, CHANGE, LogEntry
from django.contrib.auth.models import User
from django.contrib.contenttypes.models import ContentType
from django.core.exceptions import ValidationError
from django.db import transaction
from django.db.models import QuerySet
from django.utils import timezone
from django.utils.text import slugify

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.blinding.visibility import visibility_for_user
from evaweb.core.canonical_json import difference, digest
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.core.write_conflicts import once_more
from evaweb.plans import commitment as blinding
from evaweb.plans import reveals
from evaweb.plans.counting import fails_by
from evaweb.plans.design import (
    CROSSED_EVENT,
    ENDED_EVENT,
    dropped_of,
    end_at_request,
    end_reason,
    findings_of,
    recorded_so_far,
    reveal_record,
)
from evaweb.plans.draft_checks import covered, problems
from evaweb.plans.drafting import Changed, Values, apply, digest_of, merged, values_of
from evaweb.plans.frozen_document import UnevenError, document_of, units_of
from evaweb.plans.models import Plan, PlanEvent, PlanState, Slot
from evaweb.plans.schedule import Unit
from evaweb.plans.seeded_draws import new_key
from evaweb.plans.selectors import handout_of, remaining
from evaweb.trials.lifecycle import OPEN_STATES
from evaweb.trials.models import Evaluation, Trial, TrialStatus
from evaweb.trials.services import register_settled
from evaweb.trials.voids import lapse_void_requests, open_void_requests
from runtime.core.sentences import Pattern, fixed

_ADMINISTRATORS_MAKE_PLANS = fixed(
    "plans.services.administrators_make_plans",
    "new plans are made by administrators, because a blind one hides its checkpoints from the whole "
    "lab: ask one to make it with you as its owner, then you write and freeze it",
)
_NO_DRAFT_TO_EDIT = Pattern(
    "plans.services.no_draft_to_edit",
    "{plan} is {state}: only a draft is edited; amend it instead",
)
_NO_DRAFT_TO_FREEZE = Pattern(
    "plans.services.no_draft_to_freeze",
    "{plan} is {state}: only a draft is frozen; amend it instead",
)
_CHANGED_SINCE_LOADED = Pattern(
    "plans.services.changed_since_loaded",
    "{held} was changed since this page was loaded: look at it again, then freeze it",
)
_STILL_A_DRAFT = Pattern("plans.services.still_a_draft", "{held} is a draft: edit it")
_REVEALED = Pattern(
    "plans.services.revealed",
    "{held} was revealed: what is changed now would be changed with the result in view; make another plan",
)
_AMENDED_ALREADY = Pattern(
    "plans.services.amended_already",
    "{held} is amended by version {version} already",
)
_NOT_RUNNING = Pattern(
    "plans.services.not_running",
    "{held} is {state}: only a running plan is closed",
)
_NOT_CLOSED = Pattern(
    "plans.services.not_closed",
    "{held} is {state}: it is closed first, then revealed",
)
_COMMITMENT_BROKEN = Pattern(
    "plans.services.commitment_broken",
    "{held}: document, schedule and key are not those of the commitment {commitment}: someone has "
    "changed the database; nothing was revealed",
)
_RENAMED_SINCE_FROZEN = Pattern(
    "plans.services.renamed_since_frozen",
    "{held}: scenes, positions and checkpoints of its schedule are not called what they were when it "
    "was frozen: call them so again; nothing was revealed",
)
_TRIALS_UNFINISHED = Pattern(
    "plans.services.trials_unfinished",
    "{count} trials of {plan} are not finished, {code} on {name} is {status}: score or abandon them first",
)
_NOT_THE_OWNER = Pattern(
    "plans.services.not_the_owner",
    "{plan} is {user}'s: ask them, or an administrator",
)
_NO_REASON = Pattern(
    "plans.services.no_reason",
    "reason is empty: {when} only with a reason that others can read",
)

_DRAWN = (
    "stopping.counts",
    "stopping.boundary",
)  # hidden differences: with random order they reveal the schedule
_DRAWS = 200  # schedules drawn until one fits the design
_COPIED = (
    "name",
    "title",
    "question",
    "repetitions",
    "strategy",
    "blind",
    "allocation",
    "stopping",
    "comparing",
    "drop_arms",
    "outcome",
    "margin",
    "look_after",
    "alpha",
    "second_rater_share",
    "match_gate",
    "on_estop",
    "on_interruption",
    "on_timeout",
)


@once_more
@transaction.atomic
def plan_draft(*, user: User, title: str, question: str = "", **design: Any) -> Plan:
    """Create a draft owned by the user, with a name derived from the title; administrators only.

    `design` are values of further fields. Raises: EvaError, which names an invalid field.
    """
    require_drafter(user)
    plan = Plan(name=_free_name(title), title=title.strip(), question=question.strip(), owner=user, **design)
    _keep(plan)
    _log(plan, user, ADDITION, "drafted")
    return plan


def require_drafter(user: User) -> None:
    """Raise NotAllowed unless the user may create plans.

    Only administrators may, because a frozen blind plan hides its checkpoints from all users.
    """
    if role_of(user) is not Role.ADMIN:
        raise NotAllowed(_ADMINISTRATORS_MAKE_PLANS)


def require_editor(plan: Plan, user: User) -> None:
    """Raise NotAllowed if the user may not edit this draft, Conflict if it is not a draft any more."""
    _require_owner(plan, user)
    if plan.state != PlanState.DRAFT:
        raise Conflict(_NO_DRAFT_TO_EDIT(plan=plan, state=plan.get_state_display()))


@once_more
@transaction.atomic
def plan_change(
    *, user: User, plan: Plan, was: Mapping[str, Any], wanted: Values, keep: Collection[str] = ()
) -> Changed:
    """Write a user's edits of a draft: the fields whose `wanted` value differs from the value shown to the user
    (`was`).

    Fields that another user changed meanwhile stay unchanged and are reported, unless they are in `keep`.
    """
    held = _lock_plan(plan)
    require_editor(held, user)
    sight = visibility_for_user(user)
    now = values_of(held, sight)
    written, conflicts = merged(now, was, wanted, keep)
    if "owner" in written:
        require_role(user, Role.ADMIN)
    if written:
        apply(held, {**now, **written}, sight.checkpoints)
        _keep(held)
        _log(held, user, CHANGE, f"changed {', '.join(sorted(written))}")
        now = values_of(held, sight)
    return Changed(now, tuple(conflicts))


def _keep(plan: Plan) -> None:
    try:
        plan.full_clean()
    except ValidationError as invalid:
        field, said = next(iter(invalid.message_dict.items()))
        raise EvaError(f"{field}: {'; '.join(said)}") from None
    plan.save()


def _free_name(title: str) -> str:
    """Return an unused name for URLs; "new" is reserved for the page that creates plans."""
    stem = slugify(title)[:50].strip("-") or "plan"
    taken = {*Plan.objects.filter(name__startswith=stem).values_list("name", flat=True), "new"}
    names = (stem, *(f"{stem}-{number}" for number in range(2, len(taken) + 3)))
    return next(name for name in names if name not in taken)


def _log(plan: Plan, user: User, what: int, text: str) -> None:
    """Add a line to the plan's history in the admin pages; consecutive identical lines are written once."""
    rows = LogEntry.objects.filter(
        content_type=ContentType.objects.get_for_model(Plan), object_id=str(plan.pk)
    )
    last = rows.order_by("-pk").first()
    if last is None or (last.user_id, last.change_message) != (user.pk, text):
        LogEntry.objects.log_actions(user.pk, [plan], what, text, single_object=True)


def freeze_plan(*, user: User, plan: Plan, seen: str = "") -> Plan:
    """Turn a draft into an immutable document with schedule and commitment, so that trials can be handed out.

    `seen`: digest of the draft as the user sees it. Raises: Conflict if it has changed since.

    If the database was lost and trials of such a plan were restored from the disk, they are assigned to it, and it is
    closed at once, because their schedule and codes are lost; administrators only.
    """
    _require_owner(plan, user)
    if plan.state != PlanState.DRAFT:
        raise _no_draft(plan)
    _check(plan, user)
    key = _drawn(plan)  # before locking: computing a boundary takes seconds, and is cached then
    return _frozen(user, plan, key, seen)


def _no_draft(plan: Plan) -> Conflict:
    return Conflict(_NO_DRAFT_TO_FREEZE(plan=plan, state=plan.get_state_display()))


def _drawn(plan: Plan) -> bytes:
    """Return a key whose random order fits the plan's design. Raises: UnevenError after too many draws."""
    for _ in range(_DRAWS):
        key = new_key()
        with suppress(UnevenError):
            document_of(plan, key)
            return key
    document_of(plan, key)  # raises the error with its explanation
    return key


@transaction.atomic
def _frozen(user: User, plan: Plan, key: bytes, seen: str) -> Plan:
    held = _lock_plan(plan)
    _require_owner(held, user)
    if held.state != PlanState.DRAFT:
        raise _no_draft(held)
    if seen and seen != digest_of(values_of(held, visibility_for_user(user))):
        raise Conflict(_CHANGED_SINCE_LOADED(held=held))
    _check(held, user)
    document = document_of(held, key)
    held.document, held.digest, held.key = document, digest(document), key
    units = units_of(held)
    held.commitment = blinding.make_commitment(held.digest, units, bytes(held.key))
    held.evaluation, new = Evaluation.objects.get_or_create(
        name=held.name,
        version=held.version,
        defaults={"kind": Evaluation.Kind.PLAN, "description": held.title},
    )
    if not new:
        require_role(user, Role.ADMIN)  # it can reveal trials of a plan that another user may have owned
    held.state, held.frozen_at = PlanState.FROZEN, timezone.now()
    held.save()
    _create_slots(held, units)
    changes = difference(held.amends.document or {}, document) if held.amends else []
    changes = [line for line in changes if not line.startswith(_DRAWN)]
    told = f"digest {held.digest}, {len(units)} trials, commitment {held.commitment}"
    _note(held, user, "frozen", "\n".join([told, *changes]))
    if held.amends and held.amends.state == PlanState.FROZEN:
        _close(held.amends, user, f"amended by version {held.version}: {held.amended_because}")
    if held.amends and held.amends.state == PlanState.CLOSED:
        lapse_void_requests(_trials(held.amends), user=user, now=True)
    if not new:
        _close(held, user, "its trials were made before the database was lost: amend it to make more")
    plan.refresh_from_db()
    return plan


@once_more
@transaction.atomic
def amend_plan(*, user: User, plan: Plan, reason: str) -> Plan:
    """Create a draft of the next version from the frozen one, which continues until the new one is frozen."""
    held = _lock_plan(plan)
    _require_owner(held, user)
    why = _reason(reason, "a plan is amended")
    if held.state == PlanState.DRAFT:
        raise Conflict(_STILL_A_DRAFT(held=held))
    if held.state == PlanState.REVEALED:
        raise Conflict(_REVEALED(held=held))
    if hasattr(held, "amendment"):
        raise Conflict(_AMENDED_ALREADY(held=held, version=held.amendment.version))
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
def close_plan(*, user: User, plan: Plan, reason: str) -> Plan:
    """Close a plan: no more trials are handed out. Raises: Conflict while trials are unfinished."""
    held = _lock_plan(plan)
    _require_owner(held, user)
    why = _reason(reason, "a plan is closed")
    if held.state != PlanState.FROZEN:
        raise Conflict(_NOT_RUNNING(held=held, state=held.get_state_display()))
    _close(held, user, why)
    plan.refresh_from_db()
    return plan


def reveal_plan(*, user: User, plan: Plan) -> Plan:
    """Reveal the plan permanently: publish the checkpoint of each trial and the key of the commitment."""
    fresh = Plan.objects.select_related("owner").get(pk=plan.pk)
    _require_owner(fresh, user)
    ready = None
    if fresh.state == PlanState.CLOSED and fresh.at_reveal is None and reveals.first_reveal(fresh) is None:
        ready = (
            recorded_so_far(fresh),
            reveal_record(fresh),
        )  # before locking, as it may take seconds
    return _revealed(user, plan, ready)


@transaction.atomic
def _revealed(user: User, plan: Plan, ready: tuple[Hashable, dict[str, Any] | None] | None) -> Plan:
    held = _lock_plan(plan)
    _require_owner(held, user)
    if held.state != PlanState.CLOSED:
        raise Conflict(_NOT_CLOSED(held=held, state=held.get_state_display()))
    units = units_of(held)
    if not blinding.verify_commitment(
        digest(held.document or {}), units, bytes(held.key or b""), held.commitment
    ):
        raise EvaError(_COMMITMENT_BROKEN(held=held, commitment=held.commitment))
    if slots_of(held) != [unit.row for unit in units]:
        raise EvaError(_RENAMED_SINCE_FROZEN(held=held))
    lapse_void_requests(_trials(held), user=user, now=True)
    held.state, held.revealed_at, held.revealed_by = PlanState.REVEALED, timezone.now(), user
    before = reveals.first_reveal(held)
    if held.at_reveal is None:
        as_ready = ready is not None and ready[0] == recorded_so_far(held)
        held.at_reveal = (
            before.at_reveal if before else ready[1] if ready and as_ready else reveal_record(held)
        )
    if before is None:
        reveals.write_reveal(held, user, held.revealed_at)
    what = "reveal" if held.blind else "close"
    again = (
        f"; what counts is that of the {what} of {before.at:%Y-%m-%d %H:%M} UTC by {before.by}"
        if before
        else ""
    )
    held.save()
    _note(held, user, "revealed", f"key {bytes(held.key or b'').hex()}; commitment verified{again}")
    plan.refresh_from_db()
    return plan


@transaction.atomic
def end_plan_if_decided(*, user: User, plan: Plan, asked: bool = False) -> None:
    """Close a running plan whose design has ended, if no trial of it is unfinished and no void is requested.

    If trials are left, it ends only when the next one is requested (`asked`): until then a mistyped score can be
    corrected, and switching a score back and forth does not reveal which trial is of which checkpoint. A crossed
    boundary found at a request is recorded whatever is corrected later; otherwise each request would reveal the effect
    of a correction. The reason states that a boundary was crossed or all pairs are made, never for which checkpoint.
    """
    held = _lock_plan(plan)
    found = findings_of(held) if held.state == PlanState.FROZEN else None
    if found is None:
        return
    ended, waits = end_at_request(held), open_void_requests(_trials(held)).exists()
    if asked and not ended and found.ended == "boundary":
        # A refused void restores its trial; until it is answered, the result must not change.
        ended = "" if waits else end_reason(held, found)
        _note(held, user, CROSSED_EVENT if waits else ENDED_EVENT, end_reason(held, found))
    if not (ended or found.ended) or waits or _unfinished(held):
        return
    over = bool(ended) or not remaining(held, dropped_of(held))
    if not remaining(held) or (asked and over) or ended:
        why = ended or end_reason(held, found)
        if not ended:
            _note(held, user, ENDED_EVENT, why)
        _close(held, user, why)


def _on_trial_settled(trial: Trial, user: User) -> None:
    handout = handout_of(trial=trial)
    if handout is not None:
        end_plan_if_decided(user=user, plan=handout.plan)


register_settled(_on_trial_settled)


def _trials(plan: Plan) -> QuerySet[Trial]:
    return Trial.objects.filter(handout__plan=plan)


def _unfinished(plan: Plan) -> list[Trial]:
    """Return trials that are running or to be scored, including interrupted ones that the plan counts as failures."""
    states = (*OPEN_STATES, TrialStatus.ENDED, TrialStatus.INTERRUPTED)
    rows = Trial.objects.filter(handout__plan=plan, status__in=states, verdict=None)
    return [
        trial
        for trial in rows.select_related("handout", "station", "episode")
        if trial.status != TrialStatus.INTERRUPTED or fails_by(plan, trial)
    ]


def _close(plan: Plan, user: User, why: str) -> None:
    unfinished = _unfinished(plan)
    if unfinished:
        trial = unfinished[0]
        raise Conflict(
            _TRIALS_UNFINISHED(
                count=len(unfinished),
                plan=plan,
                code=trial.handout.code,
                name=trial.station.name,
                status=trial.get_status_display(),
            )
        )
    plan.state, plan.closed_at, plan.closed_because = PlanState.CLOSED, timezone.now(), why
    plan.save()
    _note(plan, user, "closed", why)
    if not plan.blind:  # an open plan may never be revealed, so its result is stored now
        transaction.on_commit(partial(_store_at_close, plan, user), robust=True)


def _store_at_close(plan: Plan, user: User) -> None:
    """Store the result of an open plan at its close; computed before locking, as that may take seconds."""
    while True:
        fresh = Plan.objects.get(pk=plan.pk)
        at, found = recorded_so_far(fresh), reveal_record(fresh)
        if found is None:
            return
        with transaction.atomic():
            held = _lock_plan(plan)
            if held.at_reveal is not None or held.state != PlanState.CLOSED or held.closed_at is None:
                return
            if recorded_so_far(held) != at:
                continue  # a score was corrected meanwhile
            before = reveals.first_reveal(held)
            held.at_reveal = before.at_reveal if before else found
            if before is None:
                reveals.write_reveal(held, user, held.closed_at)
            held.save()
            return


def _check(plan: Plan, user: User) -> None:
    """Raise EvaError with the first problem that prevents freezing, without names hidden from this user."""
    found = next(problems(plan), None)
    if found is not None:
        raise EvaError(covered(plan, visibility_for_user(user))(found.text))


def slots_of(plan: Plan) -> list[list[Any]]:
    """Return the schedule stored in the database, in the form of `Unit.row`."""
    named = ("index", "block", "checkpoint__name", "scene__name", "position__number", "repetition")
    return [list(row) for row in plan.slots.order_by("index").values_list(*named)]


def _create_slots(plan: Plan, units: list[Unit]) -> None:
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


def _lock_plan(plan: Plan) -> Plan:
    return Plan.objects.select_for_update(of=("self",)).select_related("owner").get(pk=plan.pk)


def _require_owner(plan: Plan, user: User) -> None:
    require_role(user, Role.OPERATOR)
    if plan.owner_id != user.pk and role_of(user) is not Role.ADMIN:
        raise NotAllowed(_NOT_THE_OWNER(plan=plan, user=plan.owner.get_username()))


def _note(plan: Plan, user: User, what: str, text: str) -> None:
    PlanEvent.objects.create(plan=plan, by=user, what=what, text=text)


def _reason(given: str, when: str) -> str:
    why = given.strip()
    if not why:
        raise EvaError(_NO_REASON(when=when))
    return why
