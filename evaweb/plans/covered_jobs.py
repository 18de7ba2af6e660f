"""Redaction of jobs for users from whom a checkpoint is hidden."""

from __future__ import annotations

from enum import Enum
from typing import Any

from evaweb.blinding.visibility import Visibility
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job


class Cover(Enum):
    """Part of a job that is hidden: nothing, its texts (which may name a server), or also its subject and times."""

    NOTHING = 0
    WORDS = 1
    ALL = 2


def cover_of(job: Job, sight: Visibility) -> Cover:
    """Return how much of a job is hidden from this user.

    A job of a blind trial or plan is hidden entirely. A job of a visible recording is hidden only if its texts name a
    hidden checkpoint. Of any other job the texts are hidden.
    """
    if sight.hides_nothing:
        return Cover.NOTHING
    if "uuid" in job.args:
        episode = _episode(job.args["uuid"])
        if episode is not None and sight.hides_episode(episode):
            return Cover.ALL
        return Cover.WORDS if sight.named_in(f"{job.progress} {job.error}") else Cover.NOTHING
    names_a_checkpoint = "template" in job.args
    return Cover.ALL if names_a_checkpoint or job.args.get("plan") in sight.keys else Cover.WORDS


def _episode(uuid: Any) -> Episode | None:
    return Episode.objects.select_related("trial").filter(uuid=uuid).first()
