"""Allocation of a plan's slots (scheduled trials) to stations: handed out in the plan's order, each under a code.

A block is allocated to one station as a whole, so that checkpoints are compared on the same robot at nearly the same
time. A station finishes its block, including repetitions, before it gets another.
"""

from __future__ import annotations

from dataclasses import dataclass

from django.contrib.auth.models import User
from django.db import transaction
from django.db.models import Case, Max, OuterRef, Subquery, When

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict, NotAllowed
from evaweb.plans import commitment as blinding
from evaweb.plans.blinding_rules import has_looked_at_the_same
from evaweb.plans.counting import fails_by, require_scored_first
from evaweb.plans.design import (
    dropped_of,
    end_reason,
    findings_of,
    visible_close_reason,
)
from evaweb.plans.frozen_document import require_checkpoints, require_scene, units_of
from evaweb.plans.models import Handout, Plan, PlanEvent, PlanState, Slot
from evaweb.plans.selectors import needed_handouts, without_dropped
from evaweb.plans.services import end_plan_if_decided, noted_end, slots_of
from evaweb.stations.models import Station
from evaweb.trials import lifecycle
from evaweb.trials.models import Trial, TrialStatus
from evaweb.trials.services import create_trial, require_none_open
from evaweb.trials.voids import lapse_void_requests, open_void_requests
from runtime.core.sentences import Pattern

_HAS_ENDED = Pattern("plans.allocation.has_ended", "{plan} has ended: {why}")
_NO_TRIAL_HANDED_OUT = Pattern(
    "plans.allocation.no_trial_handed_out",
    "{plan} is {state}: no trial of it is handed out",
)
_YOU_HAVE_SEEN_RESULTS_WHICH = Pattern(
    "plans.allocation.you_have_seen_results_which",
    "you have seen results of {plan}, which is blind: ask another operator to run its trials",
)
_FOR_NOT_FOR = Pattern("plans.allocation.for_not_for", "{plan} is for {allowed}, not for {name}")
_HAS_ENDED_CLOSED_ONCE = Pattern(
    "plans.allocation.has_ended_closed_once",
    "{plan} has ended: {ended_because}; it is closed once {then}",
)
_NOTHING_LEFT_FOR_TRIALS_ON = Pattern(
    "plans.allocation.nothing_left_for_trials_on",
    "nothing is left of {plan} for {name}: {count} trials are on {names}",
)
MOST_INTERRUPTIONS = 3  # in a row, of one trial at copies
_INTERRUPTED = Pattern(
    "plans.allocation.interrupted", "trial {trial} was interrupted {times} times in a row: {why}"
)
_SCORED_FIRST = Pattern(
    "plans.allocation.scored_first",
    "{plan} may drop a checkpoint: trial {trial} of an earlier block has to be scored first",
)
_AS_MANY_AS_WANTED = Pattern(
    "plans.allocation.as_many_as_wanted", "as many trials of {plan} as were wanted are handed out"
)
_ALL_TRIALS_MADE = Pattern("plans.allocation.all_trials_made", "all {count} trials of {plan} are made")
_SCENE_CHECKPOINT_RENAMED_SINCE_FROZEN = Pattern(
    "plans.allocation.scene_checkpoint_renamed_since_frozen",
    "a scene or a checkpoint was renamed since {plan} was frozen: give it its old name back",
)


_HANDED_OUT_AGAIN = (*lifecycle.REPEATABLE_STATES, TrialStatus.NOT_NEEDED)  # if the slot is needed now


class NotYet(Conflict):
    """Error if a trial of a copy has to wait until `trial`, which comes before it, is scored."""

    def __init__(self, plan: Plan, trial: Trial | None) -> None:
        super().__init__(_SCORED_FIRST(plan=plan, trial=trial.pk if trial else "-"))
        self.trial = trial


class BrokenAgain(Conflict):
    """Error if the runs of a trial at copies were interrupted again and again; the message says why."""


class NothingLeft(Conflict):
    """Error if a plan has no further trial for a station; the message says why."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Number of slots (`total`), of slots that count already, and of attempts."""

    total: int
    counted: int
    attempts: int


def plan_progress(plan: Plan) -> Progress:
    """Return the progress of a plan, without revealing any checkpoint."""
    slots = _with_newest(plan.slots.all())
    counted = slots.filter(newest=TrialStatus.SCORED).count()
    return Progress(plan.slots.count(), counted, needed_handouts(plan).count())


def allocate_trial(
    *,
    user: User,
    station: Station,
    plan: Plan,
    worker: str | None = None,
    first: int = 0,
    most: int | None = None,
) -> Handout:
    """Prepare the next trial of `plan` on `station`, or on its copy `worker`.

    `most` is the greatest number of trials at copies after handout `first`; None: all.

    Raises:
        NothingLeft: The plan has ended, or no slot is left for the station.
        NotYet: A copy has to wait for the score of a trial that comes first.
        BrokenAgain: The newest runs of the trial at copies, after handout `first`, were interrupted.
        Conflict: Its last trial is unfinished, or scene or checkpoint have changed.
        NotAllowed: The user has unblinded the plan.
    """
    require_role(user, Role.OPERATOR)
    require_allowed(plan, user, station)
    require_none_open(
        station, worker
    )  # before evaluating the design, so that the message reveals nothing about it
    with transaction.atomic():  # committed even if no trial is handed out
        locked = Plan.objects.select_for_update(of=("self",)).get(pk=plan.pk)
        lapse_void_requests(Trial.objects.filter(handout__plan=locked), user=user)
    end_plan_if_decided(user=user, plan=plan, asked=True)
    return _allocate(user, station, plan, worker, first, most)


@transaction.atomic
def _allocate(
    user: User, station: Station, plan: Plan, worker: str | None, first: int, most: int | None
) -> Handout:
    locked = (
        Plan.objects.select_for_update(of=("self",)).select_related("owner", "evaluation").get(pk=plan.pk)
    )
    require_allowed(locked, user, station)
    _check_goes_on(locked)
    slot, before = _next(locked, station)
    require_scored_first(locked, before)
    _check_unchanged(locked, slot)
    if slot.station_id is None:
        locked.slots.filter(block=slot.block).update(station=station)
    number = (locked.handouts.aggregate(last=Max("number"))["last"] or 0) + 1
    if worker is not None:
        begun = locked.handouts.filter(number__gt=first).exclude(trial__worker=None)
        if most is not None and begun.count() >= most:
            raise NothingLeft(_AS_MANY_AS_WANTED(plan=plan))
        _require_block(locked, slot)
        _require_unbroken(slot, first)
    trial = create_trial(
        user=user,
        station=station,
        evaluation=locked.evaluation,
        scene=slot.scene,
        position=slot.position,
        checkpoint=slot.checkpoint,
        number=slot.repetition,
        attempt=before.attempt + 1 if before else 1,
        strategy=(locked.document or {}).get("strategy"),
        worker=worker,
    )
    return Handout.objects.create(
        plan=locked,
        number=number,
        slot=slot,
        trial=trial,
        code=blinding.draw_codes(bytes(locked.key or b""), number)[-1],
        reason=_repeat_reason(before) if before else "",
    )


@transaction.atomic
def release_slots(*, user: User, plan: Plan, station: Station, reason: str) -> int:
    """Release the slots of `station` that are not started or must be repeated, for other stations.

    Returns: Their number.
    """
    require_role(user, Role.OPERATOR)
    locked = Plan.objects.select_for_update(of=("self",)).get(pk=plan.pk)
    mine = _with_newest(locked.slots.filter(station=station))
    idle = [slot.pk for slot in mine if slot.newest is None or slot.newest in _HANDED_OUT_AGAIN]
    freed = Slot.objects.filter(pk__in=idle).update(station=None)
    if freed:
        PlanEvent.objects.create(
            plan=locked,
            by=user,
            what="given back",
            text=f"{freed} trials of {station.name}: {reason.strip()}",
        )
    return freed


def require_allowed(plan: Plan, user: User, station: Station) -> None:
    """Raise NothingLeft, Conflict or NotAllowed unless the user may run trials of the plan at the station."""
    if plan.state != PlanState.FROZEN:
        reason = visible_close_reason(plan, sealed=True)
        raise NothingLeft(
            _HAS_ENDED(plan=plan, why=reason)
            if reason
            else _NO_TRIAL_HANDED_OUT(plan=plan, state=plan.get_state_display())
        )
    if plan.sealed and has_looked_at_the_same(plan, user):
        raise NotAllowed(_YOU_HAVE_SEEN_RESULTS_WHICH(plan=plan))
    allowed = list(plan.stations.values_list("name", flat=True))
    if allowed and station.name not in allowed:
        raise Conflict(_FOR_NOT_FOR(plan=plan, allowed=", ".join(sorted(allowed)), name=station.name))


def _check_goes_on(plan: Plan) -> None:
    waits = open_void_requests(Trial.objects.filter(handout__plan=plan)).order_by("pk").first()
    ended = noted_end(plan)
    if not ended and (result := findings_of(plan)) is not None and result.ended == "boundary":
        ended = end_reason(plan, result)  # crossed since this request began
    if ended:
        then = f"the void of trial {waits.trial_id} is answered" if waits else "its last trial is scored"
        raise NothingLeft(_HAS_ENDED_CLOSED_ONCE(plan=plan, ended_because=ended, then=then))


def _require_block(plan: Plan, slot: Slot) -> None:
    """Raise NotYet if a blind plan may drop a checkpoint by the trials of an earlier block, which do not all count.

    A trial that is begun and then dropped would tell which checkpoint it is of.
    """
    if not (plan.blind and plan.drop_arms):
        return
    earlier = without_dropped(plan.slots.filter(block__lt=slot.block), dropped_of(plan))
    first = _with_newest(earlier.order_by("index")).exclude(newest=TrialStatus.SCORED).first()
    if first is not None:
        raise NotYet(plan, _newest_trial(first))


def _require_unbroken(slot: Slot, first: int) -> None:
    """Raise BrokenAgain if each of the newest attempts at the slot, all at copies, was interrupted."""
    newer = slot.handouts.filter(number__gt=first).exclude(trial__worker=None)
    newest = [
        handout.trial for handout in newer.select_related("trial").order_by("-number")[:MOST_INTERRUPTIONS]
    ]
    if len(newest) == MOST_INTERRUPTIONS and all(trial.status == TrialStatus.INTERRUPTED for trial in newest):
        raise BrokenAgain(_INTERRUPTED(trial=newest[0].pk, times=MOST_INTERRUPTIONS, why=newest[0].reason))


def _waits_for_copies(plan: Plan, trial: Trial | None) -> bool:
    """Return True if the trial was run at a copy, and will be scored as the failure that it is by the plan."""
    if trial is None or not trial.worker or trial.verdict_id is not None or trial.truth is None:
        return False
    return trial.status == TrialStatus.INTERRUPTED and fails_by(plan, trial)


def _next(plan: Plan, station: Station) -> tuple[Slot, Trial | None]:
    """Return the next slot for the station, and its newest attempt, None if there was none.

    Raises: NothingLeft if no slot is left for the station.
    """
    tried = without_dropped(plan.slots.all(), dropped_of(plan))
    slots = _with_newest(tried.select_related("scene", "position", "checkpoint").order_by("index"))
    for slot in (*slots.filter(station=station), *slots.filter(station=None)):
        if slot.newest is None or slot.newest in _HANDED_OUT_AGAIN:
            trial = _newest_trial(slot)
            if not _waits_for_copies(plan, trial):
                return slot, trial
    elsewhere = [slot for slot in slots if slot.newest is None or slot.newest in _HANDED_OUT_AGAIN]
    if elsewhere:
        names = ", ".join(sorted({slot.station.name for slot in elsewhere if slot.station}))
        raise NothingLeft(
            _NOTHING_LEFT_FOR_TRIALS_ON(plan=plan, name=station.name, count=len(elsewhere), names=names)
        )
    raise NothingLeft(_ALL_TRIALS_MADE(count=len(slots), plan=plan))


def _with_newest(slots):  # type: ignore[no-untyped-def]
    """Annotate slots with `newest`, the status of the newest relevant trial of each slot.

    This is the trial that counts or, if none does, the newest attempt. `newest` is None before any attempt.
    """
    counts = Case(When(trial__status=TrialStatus.SCORED, then=0), default=1)
    attempts = Handout.objects.filter(slot=OuterRef("pk")).order_by(counts, "-number")
    newest = attempts.values("trial__status")[:1]
    return slots.annotate(newest=Subquery(newest))


def _newest_trial(slot: Slot) -> Trial | None:
    handout = slot.handouts.select_related("trial").order_by("-number").first()
    return handout.trial if handout else None


def _repeat_reason(before: Trial) -> str:
    text = f": {before.reason}" if before.reason else ""
    return f"attempt {before.attempt} was {TrialStatus(before.status).label}{text}"


def _check_unchanged(plan: Plan, slot: Slot) -> None:
    """Raise Conflict if schedule, scene or checkpoints differ from the frozen plan; edits need an amendment."""
    if slots_of(plan) != [unit.row for unit in units_of(plan)]:
        raise Conflict(_SCENE_CHECKPOINT_RENAMED_SINCE_FROZEN(plan=plan))
    require_scene(plan, slot.scene)
    require_checkpoints(plan)
