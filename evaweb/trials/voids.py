"""Voiding of trials; in a blind plan, a scored trial needs two operators.

An operator who knows the score of a trial could void it because of that score, and so bias the result. Therefore the
first operator requests the void, the trial is repeated meanwhile, and a second, equally blind operator agrees or
refuses. A request that is not answered in time lapses: the trial counts again, and its repetition does not.
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
    request = trial.void_requests.filter(answer="").first()
    return request is not None and _why_not(request, user) is None


def void_trial(*, user: User, trial: Trial, reason: str) -> Trial:
    """Void a trial, or request it if a second operator has to agree.

    A void is not a failure: the trial stays in the record with the reason, and is repeated.
    """
    require_role(user, Role.OPERATOR)
    text = require_reason(reason, "a trial is voided")
    with transaction.atomic():
        run_checks("voided", trial, user)
        locked = lock_trial(trial)
        if _already_requested(locked, user, text):
            return locked
        if locked.status == TrialStatus.VOID_ASKED:
            raise Conflict(_ASKED_ALREADY(trial=locked.pk, advice=lifecycle.advice(locked.status)))
        if needs_two_people(locked):
            _ask(locked, user, text)
        else:
            _void(locked, user, text)
        notify_settled(locked, user)
    trial.refresh_from_db()
    return trial


def answer_void(*, user: User, trial: Trial, agree: bool, reason: str = "") -> Trial:
    """Agree to another operator's void request, or refuse it with a reason."""
    require_role(user, Role.OPERATOR)
    text = reason if agree and not reason.strip() else require_reason(reason, "a void is refused")
    with transaction.atomic():
        locked = lock_trial(trial)
        request = locked.void_requests.filter(answer="").select_for_update().first()
        if request is None:
            raise Conflict(_NOBODY_ASKS(trial=locked.pk, label=TrialStatus(locked.status).label))
        fault = _why_not(request, user)
        if fault is not None:
            raise fault
        if agree:
            run_checks("void agreed", locked, user)
            _answered(request, VoidRequest.Answer.AGREED, user, text)
            _void(locked, request.by, request.reason)
        else:
            _restore_counting(locked, request, VoidRequest.Answer.REFUSED, user, text)
        notify_settled(locked, user)
    trial.refresh_from_db()
    return trial


def open_void_requests(trials: QuerySet[Trial]) -> QuerySet[VoidRequest]:
    """Return the unanswered void requests of these trials, oldest first."""
    return VoidRequest.objects.filter(trial__in=trials, answer="").select_related("trial__handout", "by")


def lapse_void_requests(trials: QuerySet[Trial], *, user: User, now: bool = False) -> None:
    """Restore the trials whose void requests were not answered in time.

    If `now` is set, restore all trials with an open request, however recent. A trial whose repetition is unfinished is
    restored only after the repetition has ended. Call this within a transaction.
    """
    requests = open_void_requests(trials)
    if not now:
        requests = requests.filter(at__lt=timezone.now() - ANSWERED_WITHIN)
    for request in requests.order_by("pk"):
        locked = lock_trial(request.trial)
        request.refresh_from_db(fields=("answer",))
        if request.answer:
            continue  # answered in this loop with the trial that this one repeats
        if not _repetitions(locked).filter(status__in=lifecycle.OPEN_STATES).exists():
            _restore_counting(locked, request, VoidRequest.Answer.LAPSED, user, "")


def _why_not(request: VoidRequest, user: User) -> EvaError | None:
    """Return the error for a user who may not answer the request; None if they may."""
    if request.by_id == user.pk:
        return NotAllowed(_ASKED_BY_YOU(trial_id=request.trial_id))
    if request.at + ANSWERED_WITHIN < timezone.now():
        return Conflict(_ASKED_TOO_LONG_AGO(trial_id=request.trial_id, days=ANSWERED_WITHIN.days))
    try:
        run_checks("void answered", request.trial, user)
    except EvaError as fault:
        return fault
    return None


def _ask(trial: Trial, user: User, reason: str) -> None:
    lifecycle.apply(trial, Transition.ASK)
    request = VoidRequest(trial=trial, reason=reason, by=user)
    JUDGEMENTS.append(journal_uuid(trial), VoidRequestLine.written(request))
    request.save()
    trial.save()


def _answered(request: VoidRequest, answer: str, user: User, reason: str) -> None:
    request.answer, request.answer_reason, request.answered_by = answer, reason, user
    request.answered_at = timezone.now()
    JUDGEMENTS.append(journal_uuid(request.trial), VoidAnswerLine.written(request, uuid=str(request.uuid)))
    request.save()


def _void(trial: Trial, by: User, reason: str) -> None:
    lifecycle.apply(trial, Transition.VOID)
    trial.reason, trial.voided_by, trial.voided_at = reason, by, timezone.now()
    JUDGEMENTS.append(journal_uuid(trial), VoidLine.written(trial))
    trial.save()
    request_publication(trial)


def _restore_counting(trial: Trial, request: VoidRequest, answer: str, user: User, reason: str) -> None:
    """Make the trial count again and void its repetitions."""
    for repetition in _repetitions(trial):
        if repetition.status in lifecycle.OPEN_STATES:
            raise Conflict(
                _BEING_REPEATED(
                    trial=trial.pk, other=repetition.pk, advice=lifecycle.advice(repetition.status)
                )
            )
        if lifecycle.allows(repetition, Transition.VOID):
            row = lock_trial(repetition)
            for pending in row.void_requests.filter(answer=""):
                lifecycle.apply(row, Transition.KEEP)
                _answered(pending, VoidRequest.Answer.LAPSED, user, KEPT)
            _void(row, user, KEPT)
    lifecycle.apply(trial, Transition.KEEP)
    _answered(request, answer, user, reason)
    trial.save()


def _repetitions(trial: Trial) -> QuerySet[Trial]:
    same = ("evaluation", "evaluation_version", "checkpoint", "scene", "position", "number")
    return Trial.objects.filter(**{name: getattr(trial, name) for name in same}, attempt__gt=trial.attempt)


def _already_requested(trial: Trial, user: Any, reason: str) -> bool:
    """Return True if this repeats a request whose answer was lost."""
    if trial.status == TrialStatus.VOID_ASKED:
        return trial.void_requests.filter(answer="", by=user, reason=reason).exists()
    return (trial.status, trial.reason, trial.voided_by_id) == (TrialStatus.VOIDED, reason, user.pk)
