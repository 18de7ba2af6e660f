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
    crossed_while_waiting,
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
from evaweb.trials.models import Checkpoint, Evaluation, Trial, TrialStatus
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


def copy_design(*, plan: Plan, title: str, replaced: Mapping[int, Checkpoint]) -> Plan:
    """Create a draft with the design and the owner of a plan; `replaced` are checkpoints in place of some, by id."""
    copied = {name: getattr(plan, name) for name in _COPIED if name not in ("name", "title")}
    fields = {
        name: replaced.get(getattr(plan, f"{name}_id"), getattr(plan, name)) for name in ("first", "second")
    }
    draft = Plan(**copied, **fields, name=_free_name(title), title=title, owner=plan.owner)
    _keep(draft)
    draft.positions.set(plan.positions.all())
    draft.stations.set(plan.stations.all())
    draft.checkpoints.set([replaced.get(row.pk, row) for row in plan.checkpoints.all()])
    return draft


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
    locked = _lock_plan(plan)
    require_editor(locked, user)
    visibility = visibility_for_user(user)
    now = values_of(locked, visibility)
    written, conflicts = merged(now, was, wanted, keep)
    if "owner" in written:
        require_role(user, Role.ADMIN)
    if written:
        apply(locked, {**now, **written}, visibility.checkpoints)
        _keep(locked)
        _log(locked, user, CHANGE, f"changed {', '.join(sorted(written))}")
        now = values_of(locked, visibility)
    return Changed(now, tuple(conflicts))


def _keep(plan: Plan) -> None:
    try:
        plan.full_clean()
    except ValidationError as invalid:
        field, messages = next(iter(invalid.message_dict.items()))
        raise EvaError(f"{field}: {'; '.join(messages)}") from None
    plan.save()


def _free_name(title: str) -> str:
    """Return an unused name for URLs; "new" is reserved for the page that creates plans."""
    stem = slugify(title)[:50].strip("-") or "plan"
    used = {*Plan.objects.filter(name__startswith=stem).values_list("name", flat=True), "new"}
    names = (stem, *(f"{stem}-{number}" for number in range(2, len(used) + 3)))
    return next(name for name in names if name not in used)


def _log(plan: Plan, user: User, flag: int, text: str) -> None:
    """Add a line to the plan's history in the admin pages; consecutive identical lines are written once."""
    rows = LogEntry.objects.filter(
        content_type=ContentType.objects.get_for_model(Plan), object_id=str(plan.pk)
    )
    last = rows.order_by("-pk").first()
    if last is None or (last.user_id, last.change_message) != (user.pk, text):
        LogEntry.objects.log_actions(user.pk, [plan], flag, text, single_object=True)


def freeze_plan(*, user: User, plan: Plan, seen: str = "") -> Plan:
    """Turn a draft into an immutable document with schedule and commitment, so that trials can be handed out.

    `seen` is the digest of the draft as the user sees it. Raises: Conflict if the draft has changed since.

    If the database was lost, trials of a plan with this name and version may have been restored from the disk. They are
    then assigned to this plan, and it is closed at once, because their schedule and codes are lost. Only an
    administrator may freeze such a plan.
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
    locked = _lock_plan(plan)
    _require_owner(locked, user)
    if locked.state != PlanState.DRAFT:
        raise _no_draft(locked)
    if seen and seen != digest_of(values_of(locked, visibility_for_user(user))):
        raise Conflict(_CHANGED_SINCE_LOADED(held=locked))
    _check(locked, user)
    document = document_of(locked, key)
    locked.document, locked.digest, locked.key = document, digest(document), key
    units = units_of(locked)
    locked.commitment = blinding.make_commitment(locked.digest, units, bytes(locked.key))
    locked.evaluation, new = Evaluation.objects.get_or_create(
        name=locked.name,
        version=locked.version,
        defaults={"kind": Evaluation.Kind.PLAN, "description": locked.title},
    )
    if not new:
        require_role(user, Role.ADMIN)  # it can reveal trials of a plan that another user may have owned
    locked.state, locked.frozen_at = PlanState.FROZEN, timezone.now()
    locked.save()
    _create_slots(locked, units)
    changes = difference(locked.amends.document or {}, document) if locked.amends else []
    changes = [line for line in changes if not line.startswith(_DRAWN)]
    summary = f"digest {locked.digest}, {len(units)} trials, commitment {locked.commitment}"
    _note(locked, user, "frozen", "\n".join([summary, *changes]))
    if locked.amends and locked.amends.state == PlanState.FROZEN:
        _close(locked.amends, user, f"amended by version {locked.version}: {locked.amended_because}")
    if locked.amends and locked.amends.state == PlanState.CLOSED:
        lapse_void_requests(_trials(locked.amends), user=user, now=True)
    if not new:
        _close(locked, user, "its trials were made before the database was lost: amend it to make more")
    plan.refresh_from_db()
    return plan


@once_more
@transaction.atomic
def amend_plan(*, user: User, plan: Plan, reason: str) -> Plan:
    """Create a draft of the plan's next version.

    The present version stays in force until the draft is frozen.
    """
    locked = _lock_plan(plan)
    _require_owner(locked, user)
    text = _reason(reason, "a plan is amended")
    if locked.state == PlanState.DRAFT:
        raise Conflict(_STILL_A_DRAFT(held=locked))
    if locked.state == PlanState.REVEALED:
        raise Conflict(_REVEALED(held=locked))
    if hasattr(locked, "amendment"):
        raise Conflict(_AMENDED_ALREADY(held=locked, version=locked.amendment.version))
    amendment = Plan.objects.create(
        **{name: getattr(locked, name) for name in _COPIED},
        version=locked.version + 1,
        owner=locked.owner,
        first=locked.first,
        second=locked.second,
        amends=locked,
        amended_because=text,
    )
    for name in ("positions", "checkpoints", "stations"):
        getattr(amendment, name).set(getattr(locked, name).all())
    _note(locked, user, "amended", f"version {amendment.version} is being drafted: {text}")
    return amendment


@transaction.atomic
def close_plan(*, user: User, plan: Plan, reason: str) -> Plan:
    """Close a plan: no more trials are handed out. Raises: Conflict while trials are unfinished."""
    locked = _lock_plan(plan)
    _require_owner(locked, user)
    text = _reason(reason, "a plan is closed")
    if locked.state != PlanState.FROZEN:
        raise Conflict(_NOT_RUNNING(held=locked, state=locked.get_state_display()))
    _close(locked, user, text)
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
    locked = _lock_plan(plan)
    _require_owner(locked, user)
    if locked.state != PlanState.CLOSED:
        raise Conflict(_NOT_CLOSED(held=locked, state=locked.get_state_display()))
    units = units_of(locked)
    if not blinding.verify_commitment(
        digest(locked.document or {}), units, bytes(locked.key or b""), locked.commitment
    ):
        raise EvaError(_COMMITMENT_BROKEN(held=locked, commitment=locked.commitment))
    if slots_of(locked) != [unit.row for unit in units]:
        raise EvaError(_RENAMED_SINCE_FROZEN(held=locked))
    lapse_void_requests(_trials(locked), user=user, now=True)
    locked.state, locked.revealed_at, locked.revealed_by = PlanState.REVEALED, timezone.now(), user
    before = reveals.first_reveal(locked)
    if locked.at_reveal is None:
        as_ready = ready is not None and ready[0] == recorded_so_far(locked)
        locked.at_reveal = (
            before.at_reveal if before else ready[1] if ready and as_ready else reveal_record(locked)
        )
    if before is None:
        reveals.write_reveal(locked, user, locked.revealed_at)
    act = "reveal" if locked.blind else "close"
    addition = (
        f"; what counts is that of the {act} of {before.at:%Y-%m-%d %H:%M} UTC by {before.by}"
        if before
        else ""
    )
    locked.save()
    _note(locked, user, "revealed", f"key {bytes(locked.key or b'').hex()}; commitment verified{addition}")
    plan.refresh_from_db()
    return plan


@transaction.atomic
def end_plan_if_decided(*, user: User, plan: Plan, asked: bool = False) -> None:
    """Close a running plan whose design has ended, if no trial of the plan is unfinished and no void is requested.

    If trials are left, the plan is closed only when the next trial is requested (`asked`). Until then a mistyped score
    can be corrected, and switching a score back and forth does not reveal which trial is of which checkpoint.

    A boundary that is found crossed at a request is recorded, and counts whatever is corrected later; otherwise each
    request would reveal the effect of a correction. The recorded reason says that a boundary was crossed or that all
    pairs have been run. It never says for which checkpoint a boundary was crossed.
    """
    locked = _lock_plan(plan)
    result = findings_of(locked) if locked.state == PlanState.FROZEN else None
    if result is None:
        return
    ended, waits = end_at_request(locked), open_void_requests(_trials(locked)).exists()
    if asked and not ended and result.ended == "boundary":
        # A refused void restores its trial; until it is answered, the result must not change.
        ended = "" if waits else end_reason(locked, result)
        if not (waits and noted_end(locked)):
            _note(locked, user, CROSSED_EVENT if waits else ENDED_EVENT, end_reason(locked, result))
    if not (ended or result.ended) or waits or _unfinished(locked):
        return
    over = bool(ended) or not remaining(locked, dropped_of(locked))
    if not remaining(locked) or (asked and over) or ended:
        reason = ended or end_reason(locked, result)
        if not ended:
            _note(locked, user, ENDED_EVENT, reason)
        _close(locked, user, reason)


def noted_end(plan: Plan) -> str:
    """Return the recorded reason for which no further trial is handed out; "" if there is none."""
    waits = open_void_requests(_trials(plan)).order_by("pk").first()
    return end_at_request(plan) or (crossed_while_waiting(plan, waits.at) if waits else "")


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


def _close(plan: Plan, user: User, reason: str) -> None:
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
    plan.state, plan.closed_at, plan.closed_because = PlanState.CLOSED, timezone.now(), reason
    plan.save()
    _note(plan, user, "closed", reason)
    if not plan.blind:  # an open plan may never be revealed, so its result is stored now
        transaction.on_commit(partial(_store_at_close, plan, user), robust=True)


def _store_at_close(plan: Plan, user: User) -> None:
    """Store the result of an open plan when the plan is closed.

    The result is computed before the plan is locked, because the computation may take seconds.
    """
    while True:
        fresh = Plan.objects.get(pk=plan.pk)
        at, record = recorded_so_far(fresh), reveal_record(fresh)
        if record is None:
            return
        with transaction.atomic():
            locked = _lock_plan(plan)
            if locked.at_reveal is not None or locked.state != PlanState.CLOSED or locked.closed_at is None:
                return
            if recorded_so_far(locked) != at:
                continue  # a score was corrected meanwhile
            before = reveals.first_reveal(locked)
            locked.at_reveal = before.at_reveal if before else record
            if before is None:
                reveals.write_reveal(locked, user, locked.closed_at)
            locked.save()
            return


def _check(plan: Plan, user: User) -> None:
    """Raise EvaError with the first problem that prevents freezing, without names hidden from this user."""
    problem = next(problems(plan), None)
    if problem is not None:
        raise EvaError(covered(plan, visibility_for_user(user))(problem.text))


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


def _note(plan: Plan, user: User, kind: str, text: str) -> None:
    PlanEvent.objects.create(plan=plan, by=user, what=kind, text=text)


def _reason(text: str, when: str) -> str:
    reason = text.strip()
    if not reason:
        raise EvaError(_NO_REASON(when=when))
    return reason
