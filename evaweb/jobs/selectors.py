"""Queries on jobs."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from statistics import median

from django.db.models import Case, Exists, IntegerField, OuterRef, Q, QuerySet, Value, When
from django.db.models.functions import Coalesce, Now
from django.utils import timezone

from evaweb.core.errors import NotFound
from evaweb.jobs.kinds import without_folder
from evaweb.jobs.models import Job, JobStatus
from runtime.core.sentences import Pattern

_JOB_DOES_NOT_EXIST_THIS = Pattern(
    "jobs.selectors.job_does_not_exist_this",
    "job {identity} does not exist in this lab",
)


def jobs_ready(*, queues: Collection[str], folder: bool = True, keys: str = "") -> QuerySet[Job]:
    """Return the jobs that may be claimed, oldest first; a job waits while one with its key is running.

    Without the lab's data `folder`, only kinds that do not need it. `keys` is how the keys of these jobs begin.
    """
    same_running = Job.objects.filter(key=OuterRef("key"), status=JobStatus.RUNNING)
    return (
        Job.objects.filter(
            Q() if folder else Q(kind__in=without_folder()), status=JobStatus.QUEUED, queue__in=queues
        )
        .filter(Q(not_before=None) | Q(not_before__lte=Now()), key__startswith=keys)
        .exclude(Exists(same_running))
        .order_by(Coalesce("not_before", "created_at"), "pk")
    )


def job_newest(*, key: str) -> Job | None:
    """Return the newest job of `key` in any state, None if there is none."""
    return Job.objects.filter(key=key).order_by("-created_at", "-pk").first()


def job_get(*, id: int) -> Job:
    """Return the job with that id. Raises: NotFound."""
    job = Job.objects.filter(pk=id).first()
    if job is None:
        raise NotFound(_JOB_DOES_NOT_EXIST_THIS(identity=id))
    return job


# --- how far they are ----------------------------------------------------------------------------------------

_STEPS = re.compile(r"\b([0-9]+) of ([0-9]+)\b")
_MEASURED = 20  # newest finished jobs of a kind from which its usual duration is taken
_ORDER = Case(
    When(status=JobStatus.RUNNING, then=Value(0)),
    When(status=JobStatus.QUEUED, then=Value(1)),
    When(status=JobStatus.FAILED, then=Value(2)),
    default=Value(3),
    output_field=IntegerField(),
)


@dataclass(frozen=True, slots=True)
class Pace:
    """Progress of a running job: finished `fraction` and remaining time `left_s` [s]; None if unknown."""

    fraction: float | None = None
    left_s: float | None = None


def jobs_listed(*, status: str = "", kind: str = "") -> QuerySet[Job]:
    """Return running, then queued, then failed jobs that were not requested again; newest first in each group.

    With a `status`, all jobs in that state.
    """
    rows = Job.objects.select_related("cancelled_by").order_by(_ORDER, "-created_at", "-pk")
    if kind:
        rows = rows.filter(kind=kind)
    return (
        rows.filter(status=status) if status else rows.exclude(status=JobStatus.DONE).exclude(_done_since())
    )


def jobs_failed() -> QuerySet[Job]:
    """Return the jobs that failed, were not cancelled, and were not requested again."""
    return Job.objects.filter(status=JobStatus.FAILED, cancelled_by=None).exclude(_done_since())


def _done_since() -> Q:
    """Match failed jobs with a newer job of the same key."""
    return Q(
        Q(status=JobStatus.FAILED), Exists(Job.objects.filter(key=OuterRef("key"), pk__gt=OuterRef("pk")))
    )


def pace_of(job: Job, now: datetime | None = None) -> Pace:
    """Return the estimated progress of a running job.

    The progress is computed from the steps that the job reports ("n of m") and their rate so far; without such steps,
    from the median duration of the last jobs of the same kind.
    """
    if job.status != JobStatus.RUNNING or job.claimed_at is None:
        return Pace()
    took = max(0.0, ((now or timezone.now()) - job.claimed_at).total_seconds())
    steps = _STEPS.search(job.progress)
    if steps and 0 < int(steps[1]) <= int(steps[2]):
        completed, all_of_them = int(steps[1]) - 1, int(steps[2])  # step n itself is still running
        return Pace(
            completed / all_of_them, took / completed * (all_of_them - completed) if completed else None
        )
    usual = _usual_s(job.kind)
    return Pace(min(1.0, took / usual), max(0.0, usual - took)) if usual and took <= usual else Pace()


def _usual_s(kind: str) -> float | None:
    ended = Job.objects.filter(kind=kind, status=JobStatus.DONE, claimed_at__isnull=False)
    times = ended.order_by("-finished_at").values_list("claimed_at", "finished_at")[:_MEASURED]
    took = [(finished - claimed).total_seconds() for claimed, finished in times if finished is not None]
    return median(took) if took else None
