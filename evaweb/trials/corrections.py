"""Corrections of only the failure phase and cause of a score."""

from __future__ import annotations

from collections.abc import Mapping
from uuid import UUID

from django.contrib.auth.models import User
from django.db import transaction

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict
from evaweb.records.journal import clean_text
from evaweb.stations.commands import parse_command_uuid
from evaweb.trials import failures
from evaweb.trials.failure_text import UNSPECIFIED, failure_text
from evaweb.trials.models import MilestoneOutcome, Score, Trial, TrialStatus
from evaweb.trials.scoring import LONGEST_NOTE
from evaweb.trials.services import counts_now, lock_trial, require_scorable, run_checks
from runtime.core.sentences import Pattern

_TRIAL_ONLY_SCORE_COUNTS_HAS = Pattern(
    "trials.corrections.trial_only_score_counts_has",
    "trial {trial} is {status}: only a score that counts has a failure",
)
_TRIAL_SCORED_ANEW_BY_MEANWHILE = Pattern(
    "trials.corrections.trial_scored_anew_by_meanwhile",
    "trial {trial} was scored anew by {user} meanwhile ({why}): look at it again",
)


def trial_failure(
    *,
    user: User,
    trial: Trial,
    failure: str | None = None,
    failure_phase: str | None = None,
    score: UUID | str | None = None,
    reason: str = "",
) -> Score:
    """Correct why a trial failed, without changing its score otherwise.

    `failure` is the cause and `failure_phase` the phase; None leaves the present one unchanged. Success, points and
    milestones are copied from the current score, not evaluated with the scene as it is now. Without a `reason`, the old
    and new terms are recorded as the reason. An identical request adds nothing.

    Raises: Conflict if the trial has no score that counts, or if the score that counts is not the one with the uuid
    `score`, which the user saw.
    """
    require_role(user, Role.OPERATOR)
    with transaction.atomic():
        locked = lock_trial(trial)
        verdict = locked.verdict
        if verdict is None or locked.status != TrialStatus.SCORED:
            raise Conflict(_TRIAL_ONLY_SCORE_COUNTS_HAS(trial=locked.pk, status=locked.get_status_display()))
        values = {"failure": failure, "failure_phase": failure_phase}
        texts = {
            field: seen_words if (new := values[field]) is None else new.strip()
            for field, seen_words in failures.score_failure(verdict).items()
        }
        if texts == failures.score_failure(verdict):
            return verdict
        if score is not None and parse_command_uuid(score) != verdict.uuid:
            raise Conflict(
                _TRIAL_SCORED_ANEW_BY_MEANWHILE(
                    trial=locked.pk,
                    user=verdict.rater.get_username(),
                    why=verdict.why or f"failure {UNSPECIFIED}",
                )
            )
        after = failure_text(texts["failure_phase"], texts["failure"])
        text = reason or f"failure was {verdict.why or UNSPECIFIED}, now {after or UNSPECIFIED}"
        reworded = _reworded(
            user, locked, verdict, failures.clean_failure(**texts), clean_text("reason", text, LONGEST_NOTE)
        )
    trial.refresh_from_db()
    return reworded


def _reworded(user: User, trial: Trial, verdict: Score, texts: Mapping[str, str], reason: str) -> Score:
    """Add a copy of the score `verdict` with the failure phase and cause in `texts`.

    Its milestones are copied too, even if the scene's milestones have changed since.
    """
    for check in ("scored", "reworded"):
        run_checks(check, trial, user)
    require_scorable(trial, reason)
    failures.check_failure(trial.scene, texts, success=verdict.success, said=failures.score_failure(verdict))
    score = Score(
        trial=trial,
        rater=user,
        success=verdict.success,
        score=verdict.score,
        note=verdict.note,
        reason=reason,
        **texts,
    )
    outcomes = [
        MilestoneOutcome(
            score=score,
            milestone_id=row.milestone_id,
            order=row.order,
            text=row.text,
            points=row.points,
            required=row.required,
            reached=row.reached,
            at_s=row.at_s,
        )
        for row in verdict.outcomes.all()
    ]
    counts_now(trial, score, outcomes, user)
    return score
