"""Reads of jobs."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from statistics import median

from django.db.models import Case, Exists, IntegerField, OuterRef, Q, QuerySet, Value, When
from django.db.models.functions import Now
from django.utils import timezone

from evaweb.errors import NotFound
from evaweb.jobs.kinds import without_folder
from evaweb.jobs.models import Job, JobStatus
from runtime.core.sentences import Pattern

_JOB_DOES_NOT_EXIST_THIS = Pattern(
    "jobs.selectors.job_does_not_exist_this",
    "job {identity} does not exist in this lab",
)


def jobs_ready(*, queues: Collection[str], folder: bool = True) -> QuerySet[Job]:
    """Those that may be claimed, oldest first; one whose key is being worked on waits for that.

    Without the lab's data `folder` only those that do not need it.
    """
    same_running = Job.objects.filter(key=OuterRef("key"), status=JobStatus.RUNNING)
    return (
        Job.objects.filter(
            Q() if folder else Q(kind__in=without_folder()), status=JobStatus.QUEUED, queue__in=queues
        )
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
        raise NotFound(_JOB_DOES_NOT_EXIST_THIS(identity=id))
    return found


# --- how far they are ----------------------------------------------------------------------------------------

_STEPS = re.compile(r"\b([0-9]+) of ([0-9]+)\b")
_MEASURED = 20  # newest jobs of a kind
_ORDER = Case(
    When(status=JobStatus.RUNNING, then=Value(0)),
    When(status=JobStatus.QUEUED, then=Value(1)),
    When(status=JobStatus.FAILED, then=Value(2)),
    default=Value(3),
    output_field=IntegerField(),
)


@dataclass(frozen=True, slots=True)
class Pace:
    """How far a running job is: the `fraction` that is done, and seconds that are left; None where nobody knows."""

    fraction: float | None = None
    left_s: float | None = None


def jobs_listed(*, status: str = "", kind: str = "") -> QuerySet[Job]:
    """Those that run, then those that wait, then those that failed and were not asked for again since.

    With a `status` all of that one; the newest of each first.
    """
    rows = Job.objects.select_related("cancelled_by").order_by(_ORDER, "-created_at", "-pk")
    if kind:
        rows = rows.filter(kind=kind)
    return (
        rows.filter(status=status) if status else rows.exclude(status=JobStatus.DONE).exclude(_done_since())
    )


def jobs_failed() -> QuerySet[Job]:
    """Those that failed, were not cancelled, and were not asked for again since."""
    return Job.objects.filter(status=JobStatus.FAILED, cancelled_by=None).exclude(_done_since())


def _done_since() -> Q:
    """Failed, and there is a newer one of the same key."""
    return Q(
        Q(status=JobStatus.FAILED), Exists(Job.objects.filter(key=OuterRef("key"), pk__gt=OuterRef("pk")))
    )


def pace_of(job: Job, now: datetime | None = None) -> Pace:
    """By the steps that it tells and the rate so far; where it tells none, by the time that the last ones took."""
    if job.status != JobStatus.RUNNING or job.claimed_at is None:
        return Pace()
    took = max(0.0, ((now or timezone.now()) - job.claimed_at).total_seconds())
    steps = _STEPS.search(job.progress)
    if steps and 0 < int(steps[1]) <= int(steps[2]):
        done, all_of_them = int(steps[1]) - 1, int(steps[2])  # the one that is named is under way
        return Pace(done / all_of_them, took / done * (all_of_them - done) if done else None)
    usual = _usual_s(job.kind)
    return Pace(min(1.0, took / usual), max(0.0, usual - took)) if usual and took <= usual else Pace()


def _usual_s(kind: str) -> float | None:
    ended = Job.objects.filter(kind=kind, status=JobStatus.DONE, claimed_at__isnull=False)
    times = ended.order_by("-finished_at").values_list("claimed_at", "finished_at")[:_MEASURED]
    took = [(finished - claimed).total_seconds() for claimed, finished in times if finished is not None]
    return median(took) if took else None
