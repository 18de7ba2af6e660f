"""Jobs of the worker, current and past."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from django.http import HttpRequest
from ninja import Query, Router, Schema, Status

from evaweb.api.responses import FAILURES, Page, Paging
from evaweb.blinding.visibility import HIDDEN, Visibility, visibility_for_request
from evaweb.jobs import services
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.selectors import job_get
from evaweb.plans.covered_jobs import Cover, cover_of

router = Router(tags=["jobs"])


class JobOut(Schema):
    """One job; `error` is that of its last attempt.

    `attempts` counts the attempts that ended in an error, `deaths` the workers that died or became silent during it.
    Before the reveal, a job of a blind trial has neither key, times nor texts for a user who has not unblinded the
    plan. Jobs other than those of recordings have no texts either, because these may name a server.
    """

    id: int
    kind: str
    key: str
    queue: str
    status: JobStatus
    attempts: int
    deaths: int
    progress: str
    error: str
    result: dict[str, Any]
    created_at: datetime | None
    claimed_at: datetime | None
    finished_at: datetime | None

    @staticmethod
    def of(job: Job, sight: Visibility) -> dict[str, Any]:
        """Return the job, without fields that may reveal a hidden checkpoint."""
        own = {name: getattr(job, name) for name in JobOut.model_fields}
        cover = cover_of(job, sight)
        if cover is Cover.NOTHING:
            return own
        own |= {name: HIDDEN if own[name] else "" for name in ("progress", "error")} | {"result": {}}
        if cover is Cover.ALL:
            own |= {"key": HIDDEN, "created_at": None, "claimed_at": None, "finished_at": None}
        return own


@router.get("", response={200: Page[JobOut], **FAILURES}, summary="Jobs", url_name="jobs")
def jobs(
    request: HttpRequest,
    paging: Query[Paging],
    status: JobStatus | None = None,
    kind: str = "",
    key: str = "",
) -> Any:
    """Return the jobs, newest first."""
    rows = Job.objects.order_by("-created_at", "-pk")
    lookups = {"status": status and status.value, "kind": kind, "key": key}
    return paging.page(
        rows.filter(**{name: value for name, value in lookups.items() if value}),
        JobOut,
        visibility_for_request(request),
    )


@router.post("/{id}/retry", response={202: JobOut, **FAILURES}, summary="Try again", url_name="job-retry")
def retry(request: HttpRequest, id: int) -> Any:
    """Queue a failed job again. Requires the role that may request such a job."""
    job = services.retry_job(user=request.auth, job=job_get(id=id))
    return Status(202, JobOut.of(job, visibility_for_request(request)))


@router.post("/{id}/cancel", response={200: JobOut, **FAILURES}, summary="Cancel", url_name="job-cancel")
def cancel(request: HttpRequest, id: int) -> Any:
    """Cancel a job: immediately if it is waiting, otherwise at its next step. Requires an operator."""
    return JobOut.of(services.cancel(user=request.auth, job=job_get(id=id)), visibility_for_request(request))
