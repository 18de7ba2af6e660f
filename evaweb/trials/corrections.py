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
    """Correct why a trial failed, without changing its score otherwise; None leaves a level unchanged.

    Success, points and milestones are copied from the current score, not evaluated with the scene as it is now. Without
    a `reason`, the old and new terms are recorded as the reason. An identical request adds nothing.

    Raises: Conflict if the trial has no score that counts, or if `score`, the uuid of the score that the user saw, is
    not that score.
    """
    require_role(user, Role.OPERATOR)
    with transaction.atomic():
        held = lock_trial(trial)
        seen = held.verdict
        if seen is None or held.status != TrialStatus.SCORED:
            raise Conflict(_TRIAL_ONLY_SCORE_COUNTS_HAS(trial=held.pk, status=held.get_status_display()))
        given = {"failure": failure, "failure_phase": failure_phase}
        words = {
            field: seen_words if (new := given[field]) is None else new.strip()
            for field, seen_words in failures.score_failure(seen).items()
        }
        if words == failures.score_failure(seen):
            return seen
        if score is not None and parse_command_uuid(score) != seen.uuid:
            raise Conflict(
                _TRIAL_SCORED_ANEW_BY_MEANWHILE(
                    trial=held.pk, user=seen.rater.get_username(), why=seen.why or f"failure {UNSPECIFIED}"
                )
            )
        after = failure_text(words["failure_phase"], words["failure"])
        why = reason or f"failure was {seen.why or UNSPECIFIED}, now {after or UNSPECIFIED}"
        found = _reworded(
            user, held, seen, failures.clean_failure(**words), clean_text("reason", why, LONGEST_NOTE)
        )
    trial.refresh_from_db()
    return found


def _reworded(user: User, held: Trial, seen: Score, words: Mapping[str, str], reason: str) -> Score:
    """Add a copy of the score `seen` with other words for the failure.

    Its milestones are copied too, even if the scene's milestones have changed since.
    """
    for what in ("scored", "reworded"):
        run_checks(what, held, user)
    require_scorable(held, reason)
    failures.check_failure(held.scene, words, success=seen.success, said=failures.score_failure(seen))
    found = Score(
        trial=held,
        rater=user,
        success=seen.success,
        score=seen.score,
        note=seen.note,
        reason=reason,
        **words,
    )
    outcomes = [
        MilestoneOutcome(
            score=found,
            milestone_id=row.milestone_id,
            order=row.order,
            text=row.text,
            points=row.points,
            required=row.required,
            reached=row.reached,
            at_s=row.at_s,
        )
        for row in seen.outcomes.all()
    ]
    counts_now(held, found, outcomes, user)
    return found
