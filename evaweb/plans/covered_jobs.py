"""Jobs as they are shown to somebody from whom a checkpoint is hidden."""

from __future__ import annotations

from enum import Enum
from typing import Any

from evaweb.blinding import Visibility
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job


class Cover(Enum):
    """What of a job is covered: nothing, its words (they may name a server), or also what it is about and when."""

    NOTHING = 0
    WORDS = 1
    ALL = 2


def cover_of(job: Job, sight: Visibility) -> Cover:
    """Of a recording that is not hidden nothing is covered, of a blind trial all, of other work its words."""
    if sight.sees_everything:
        return Cover.NOTHING
    if "uuid" in job.args:
        found = _episode(job.args["uuid"])
        if found is not None and sight.hides_episode(found):
            return Cover.ALL
        return Cover.WORDS if sight.named_in(f"{job.progress} {job.error}") else Cover.NOTHING
    return Cover.ALL if job.args.get("plan") in sight.keys else Cover.WORDS


def _episode(uuid: Any) -> Episode | None:
    return Episode.objects.select_related("trial").filter(uuid=uuid).first()
