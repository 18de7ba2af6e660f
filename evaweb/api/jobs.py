"""What the worker does and has done."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from django.http import HttpRequest
from ninja import Query, Router, Schema

from evaweb.api.answers import FAILURES, Page, Paging
from evaweb.jobs.models import Job, JobStatus

router = Router(tags=["jobs"])


class JobOut(Schema):
    """One piece of work; `error` is that of the last attempt."""

    id: int
    kind: str
    key: str
    queue: str
    status: JobStatus
    attempts: int
    progress: str
    error: str
    result: dict[str, Any]
    created_at: datetime
    claimed_at: datetime | None
    finished_at: datetime | None

    @staticmethod
    def of(job: Job) -> Job:
        """As it is."""
        return job


@router.get("", response={200: Page[JobOut], **FAILURES}, summary="Jobs", url_name="jobs")
def jobs(
    request: HttpRequest,
    paging: Query[Paging],
    status: JobStatus | None = None,
    kind: str = "",
    key: str = "",
) -> Any:
    """The newest first."""
    rows = Job.objects.order_by("-created_at", "-pk")
    wanted = {"status": status and status.value, "kind": kind, "key": key}
    return paging.of(rows.filter(**{name: value for name, value in wanted.items() if value}), JobOut)
