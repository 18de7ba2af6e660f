"""DATA/scores/<uuid>.jsonl: every verdict on an episode, one line each, from which the database can be restored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import UUID

from django.conf import settings

from evaweb.journal import append_line
from evaweb.trials.facts import trial_course
from evaweb.trials.models import MilestoneOutcome, Score, Trial


def path_of(uuid: UUID) -> Path:
    """The file of an episode, or of a trial that was not recorded."""
    return Path(settings.DATA_DIR) / "scores" / f"{uuid}.jsonl"


def score_line(score: Score, outcomes: Sequence[MilestoneOutcome]) -> dict[str, Any]:
    """The line of a score that is about to be saved; evaweb.trials.kept reads it back."""
    milestones = [
        {name: getattr(outcome, name) for name in ("order", "text", "points", "required", "reached", "at_s")}
        for outcome in outcomes
    ]
    words = {
        name: getattr(score, name) for name in ("success", "score", "note", "failure", "reason", "source")
    }
    return {
        "kind": "score",
        "uuid": str(score.uuid),
        "trial": trial_course(score.trial),
        "rater": score.rater.get_username(),
        "at": score.scored_at.isoformat(),
        **words,
        "milestones": milestones,
    }


def void_line(trial: Trial) -> dict[str, Any]:
    """The line of a trial that is about to be saved as voided; evaweb.trials.kept reads it back."""
    assert trial.voided_by is not None
    assert trial.voided_at is not None
    return {
        "kind": "void",
        "trial": trial_course(trial),
        "by": trial.voided_by.get_username(),
        "reason": trial.reason,
        "at": trial.voided_at.isoformat(),
    }


def append(uuid: UUID, line: Mapping[str, Any]) -> None:
    """Add one line and wait until it is on the disk; the caller holds the trial's row. Raises NotKept."""
    append_line(path_of(uuid), line)
