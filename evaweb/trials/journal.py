"""DATA/scores/<uuid>.jsonl: every verdict on an episode, one line each, from which the database can be restored."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import UUID

from django.conf import settings

from evaweb.errors import EvaError
from evaweb.trials.facts import trial_course
from evaweb.trials.models import MilestoneOutcome, Score, Trial


class NotKept(EvaError):
    """The disk did not take it, and so the database was not told either."""

    status = 507


def path_of(uuid: UUID) -> Path:
    """The file of an episode, or of a trial that was not recorded."""
    return Path(settings.DATA_DIR) / "scores" / f"{uuid}.jsonl"


def score_line(score: Score, outcomes: Sequence[MilestoneOutcome]) -> dict[str, Any]:
    """The line of a score that is about to be saved; evaweb.trials.kept reads it back."""
    milestones = [
        {name: getattr(outcome, name) for name in ("order", "text", "points", "required", "reached")}
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
    """Add one line and wait until it is on the disk; a line torn by a crash before it stays a line of its own.

    The caller holds the trial's row, so that there is one writer at a time. Raises NotKept.
    """
    path = path_of(uuid)
    text = json.dumps(line, allow_nan=False, separators=(",", ":"))  # ASCII: no character in it ends a line
    try:
        _written(path, text.encode() + b"\n")
    except OSError as error:
        raise NotKept(f"not kept: {error.strerror} ({path}); nothing was changed") from error


def _written(path: Path, payload: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        new = file.tell() == 0
        if not new:
            file.seek(-1, os.SEEK_END)
            payload = payload if file.read(1) == b"\n" else b"\n" + payload
        file.write(payload)
        file.flush()
        os.fsync(file.fileno())
    if new:
        _sync_folder(path.parent)
        _sync_folder(path.parent.parent)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
