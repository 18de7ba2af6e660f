"""Redaction of jobs for users from whom a checkpoint is hidden."""

from __future__ import annotations

from enum import Enum
from typing import Any

from evaweb.blinding.visibility import Visibility
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job


class Cover(Enum):
    """Hidden part of a job: nothing, its texts (which may name a server), or also its subject and times."""

    NOTHING = 0
    WORDS = 1
    ALL = 2


def cover_of(job: Job, sight: Visibility) -> Cover:
    """Return how much of a job is hidden from this user.

    All for a blind trial or plan; nothing for a visible recording, unless its texts name a hidden checkpoint; the texts
    for everything else.
    """
    if sight.hides_nothing:
        return Cover.NOTHING
    if "uuid" in job.args:
        found = _episode(job.args["uuid"])
        if found is not None and sight.hides_episode(found):
            return Cover.ALL
        return Cover.WORDS if sight.named_in(f"{job.progress} {job.error}") else Cover.NOTHING
    return Cover.ALL if job.args.get("plan") in sight.keys else Cover.WORDS


def _episode(uuid: Any) -> Episode | None:
    return Episode.objects.select_related("trial").filter(uuid=uuid).first()
