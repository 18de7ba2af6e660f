"""Reads of jobs."""

from __future__ import annotations

from collections.abc import Collection

from django.db.models import Exists, OuterRef, Q, QuerySet
from django.db.models.functions import Now

from evaweb.errors import NotFound
from evaweb.jobs.models import Job, JobStatus


def jobs_ready(*, queues: Collection[str]) -> QuerySet[Job]:
    """Those that may be claimed, oldest first; one whose key is being worked on waits for that."""
    same_running = Job.objects.filter(key=OuterRef("key"), status=JobStatus.RUNNING)
    return (
        Job.objects.filter(status=JobStatus.QUEUED, queue__in=queues)
        .filter(Q(not_before=None) | Q(not_before__lte=Now()))
        .exclude(Exists(same_running))
        .order_by("created_at", "pk")
    )


def job_newest(*, key: str) -> Job | None:
    """The last job about `key`, whatever became of it."""
    return Job.objects.filter(key=key).order_by("-created_at", "-pk").first()


def job_get(*, id: int) -> Job:
    """The job of that number; NotFound where there is none."""
    found = Job.objects.filter(pk=id).first()
    if found is None:
        raise NotFound(f"job {id} does not exist in this lab")
    return found
