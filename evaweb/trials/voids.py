"""Voiding of trials; in a blind plan, a scored trial needs two operators.

An operator who knows a trial's score could select by it. So the first operator requests the void, the trial is repeated
meanwhile, and a second, equally blind operator agrees or refuses. A request that is not answered in time lapses: the
trial counts again, and its repetition does not.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from typing import Any

from django.contrib.auth.models import User
from django.db import transaction
from django.db.models import QuerySet
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.trials import lifecycle
from evaweb.trials.lifecycle import Transition
from evaweb.trials.models import Trial, TrialStatus, VoidRequest
from evaweb.trials.record import (
    JUDGEMENTS,
    VoidAnswerLine,
    VoidLine,
    VoidRequestLine,
    journal_uuid,
)
from evaweb.trials.services import lock_trial, notify_settled, request_publication, require_reason, run_checks
from runtime.core.sentences import Pattern

_ASKED_ALREADY = Pattern(
    "trials.voids.asked_already",
    "the void of trial {trial} was asked for already: {advice}",
)
_NOBODY_ASKS = Pattern(
    "trials.voids.nobody_asks",
    "trial {trial} is {label}: there is no request to void it",
)
_ASKED_BY_YOU = Pattern(
    "trials.voids.asked_by_you",
    "you asked for the void of trial {trial_id}: another operator has to answer",
)
_ASKED_TOO_LONG_AGO = Pattern(
    "trials.voids.asked_too_long_ago",
    "the void of trial {trial_id} was asked for more than {days} days ago: it counts",
)
_BEING_REPEATED = Pattern(
    "trials.voids.being_repeated",
    "trial {trial} is being repeated, by trial {other}: {advice}, then refuse",
)

ANSWERED_WITHIN = timedelta(days=14)
KEPT = "the trial that it repeats counts: its void was not agreed to"
_rules: list[Callable[[Trial], bool]] = []


def register_two_person_rule(rule: Callable[[Trial], bool]) -> None:
    """Register a rule that returns whether voiding a scored trial needs a second operator."""
    _rules.append(rule)


def needs_two_people(trial: Trial) -> bool:
    """Return True if voiding the trial needs the agreement of a second operator."""
    return trial.verdict_id is not None and any(rule(trial) for rule in _rules)


def can_answer_void(trial: Trial, user: User) -> bool:
    """Return True if the trial has an open void request that this user may answer."""
    asked = trial.void_requests.filter(answer="").first()
    return asked is not None and _why_not(asked, user) is None


def void_trial(*, user: User, trial: Trial, reason: str) -> Trial:
    """Void a trial, or request it if a second operator has to agree.

    A void is not a failure: the trial stays in the record with the reason, and is repeated.
    """
    require_role(user, Role.OPERATOR)
    why = require_reason(reason, "a trial is voided")
    with transaction.atomic():
        run_checks("voided", trial, user)
        held = lock_trial(trial)
        if _already_requested(held, user, why):
            return held
        if held.status == TrialStatus.VOID_ASKED:
            raise Conflict(_ASKED_ALREADY(trial=held.pk, advice=lifecycle.advice(held.status)))
        if needs_two_people(held):
            _ask(held, user, why)
        else:
            _void(held, user, why)
        notify_settled(held, user)
    trial.refresh_from_db()
    return trial


def answer_void(*, user: User, trial: Trial, agree: bool, reason: str = "") -> Trial:
    """Agree to another operator's void request, or refuse it with a reason."""
    require_role(user, Role.OPERATOR)
    why = reason if agree and not reason.strip() else require_reason(reason, "a void is refused")
    with transaction.atomic():
        held = lock_trial(trial)
        asked = held.void_requests.filter(answer="").select_for_update().first()
        if asked is None:
            raise Conflict(_NOBODY_ASKS(trial=held.pk, label=TrialStatus(held.status).label))
        fault = _why_not(asked, user)
        if fault is not None:
            raise fault
        if agree:
            run_checks("void agreed", held, user)
            _answered(asked, VoidRequest.Answer.AGREED, user, why)
            _void(held, asked.by, asked.reason)
        else:
            _restore_counting(held, asked, VoidRequest.Answer.REFUSED, user, why)
        notify_settled(held, user)
    trial.refresh_from_db()
    return trial


def open_void_requests(trials: QuerySet[Trial]) -> QuerySet[VoidRequest]:
    """Return the unanswered void requests of these trials, oldest first."""
    return VoidRequest.objects.filter(trial__in=trials, answer="").select_related("trial__handout", "by")


def lapse_void_requests(trials: QuerySet[Trial], *, user: User, now: bool = False) -> None:
    """Restore trials whose void request was not answered in time, or with `now` all with an open request.

    Trials with an unfinished repetition wait for its end. Call within a transaction.
    """
    asked = open_void_requests(trials)
    if not now:
        asked = asked.filter(at__lt=timezone.now() - ANSWERED_WITHIN)
    for each in asked.order_by("pk"):
        held = lock_trial(each.trial)
        each.refresh_from_db(fields=("answer",))
        if each.answer:
            continue  # answered in this loop with the trial that this one repeats
        if not _repetitions(held).filter(status__in=lifecycle.OPEN_STATES).exists():
            _restore_counting(held, each, VoidRequest.Answer.LAPSED, user, "")


def _why_not(asked: VoidRequest, user: User) -> EvaError | None:
    """Return the error for a user who may not answer the request; None if they may."""
    if asked.by_id == user.pk:
        return NotAllowed(_ASKED_BY_YOU(trial_id=asked.trial_id))
    if asked.at + ANSWERED_WITHIN < timezone.now():
        return Conflict(_ASKED_TOO_LONG_AGO(trial_id=asked.trial_id, days=ANSWERED_WITHIN.days))
    try:
        run_checks("void answered", asked.trial, user)
    except EvaError as fault:
        return fault
    return None


def _ask(held: Trial, user: User, why: str) -> None:
    lifecycle.apply(held, Transition.ASK)
    asked = VoidRequest(trial=held, reason=why, by=user)
    JUDGEMENTS.append(journal_uuid(held), VoidRequestLine.written(asked))
    asked.save()
    held.save()


def _answered(asked: VoidRequest, answer: str, user: User, why: str) -> None:
    asked.answer, asked.answer_reason, asked.answered_by = answer, why, user
    asked.answered_at = timezone.now()
    JUDGEMENTS.append(journal_uuid(asked.trial), VoidAnswerLine.written(asked, uuid=str(asked.uuid)))
    asked.save()


def _void(held: Trial, by: User, why: str) -> None:
    lifecycle.apply(held, Transition.VOID)
    held.reason, held.voided_by, held.voided_at = why, by, timezone.now()
    JUDGEMENTS.append(journal_uuid(held), VoidLine.written(held))
    held.save()
    request_publication(held)


def _restore_counting(held: Trial, asked: VoidRequest, answer: str, user: User, why: str) -> None:
    """Make the trial count again and void its repetitions."""
    for other in _repetitions(held):
        if other.status in lifecycle.OPEN_STATES:
            raise Conflict(
                _BEING_REPEATED(trial=held.pk, other=other.pk, advice=lifecycle.advice(other.status))
            )
        if lifecycle.allows(other, Transition.VOID):
            row = lock_trial(other)
            for pending in row.void_requests.filter(answer=""):
                lifecycle.apply(row, Transition.KEEP)
                _answered(pending, VoidRequest.Answer.LAPSED, user, KEPT)
            _void(row, user, KEPT)
    lifecycle.apply(held, Transition.KEEP)
    _answered(asked, answer, user, why)
    held.save()


def _repetitions(trial: Trial) -> QuerySet[Trial]:
    same = ("evaluation", "evaluation_version", "checkpoint", "scene", "position", "number")
    return Trial.objects.filter(**{name: getattr(trial, name) for name in same}, attempt__gt=trial.attempt)


def _already_requested(held: Trial, user: Any, why: str) -> bool:
    """Return True if this repeats a request whose answer was lost."""
    if held.status == TrialStatus.VOID_ASKED:
        return held.void_requests.filter(answer="", by=user, reason=why).exists()
    return (held.status, held.reason, held.voided_by_id) == (TrialStatus.VOIDED, why, user.pk)
