"""Page of jobs: running, queued and failed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from django.contrib import messages
from django.http import HttpRequest, HttpResponse
from django.http.response import HttpResponseBase
from django.shortcuts import redirect, render
from django.urls import reverse
from django.views.decorators.http import require_GET, require_POST

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.blinding.visibility import HIDDEN, Visibility, visibility_for_request
from evaweb.core.errors import EvaError
from evaweb.core.printed_names import is_name
from evaweb.datasets import dataset_jobs
from evaweb.datasets.dataset_orders import KIND as DATASET
from evaweb.jobs import services
from evaweb.jobs.kinds import starts_elsewhere
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.selectors import Pace, job_get, jobs_listed, pace_of
from evaweb.jobs.workers import Served, served
from evaweb.plans.covered_jobs import Cover, cover_of
from evaweb.plans.models import Plan
from evaweb.serving.lists import Column, Filter, Listing

PER_PAGE = 50
# Display names of the kinds.
KINDS = {
    "preview": "Preview",
    "quality": "Checks",
    "publish": "Publication",
    "export": "Table",
    "mcap": "MCAP file",
    "store": "Videos into the store",
    "archive": "Recording into the store",
    "smoothness": "Smoothness",
    "sides": "Reviews of a published episode",
    "dataset": "Dataset",
    "judge": "Automatic judge",
    "preflight": "Preflight",
    "scrub": "Verification of recordings",
    "reconcile": "Reading the disk",
    "copies": "Trials without people",
    "template": "Plan of a new checkpoint",
    "diagnose": "Diagnostic bundle",
}
_ACTS = {"cancel": "cancelled", "repeat": "asked for again"}


@dataclass(frozen=True, slots=True)
class Row:
    """Job as displayed: its subject with an address, its progress, and the possible actions."""

    job: Job
    title: str
    about: str
    address: str
    pace: Pace
    said: str
    lacks: str  # reason for which no running worker can run it
    covered: bool = False  # job of a blind trial: neither its time nor its subject is shown

    @property
    def may_cancel(self) -> bool:
        """True if the job has not ended and was not cancelled."""
        return self.job.cancelled_by_id is None and self.job.status in (JobStatus.QUEUED, JobStatus.RUNNING)

    @property
    def may_repeat(self) -> bool:
        """True if the job has failed."""
        return self.job.status == JobStatus.FAILED and not starts_elsewhere(self.job.kind)

    @property
    def minutes_left(self) -> str:
        """Remaining time as text."""
        left = self.pace.left_s
        if left is None:
            return ""
        return f"about {left:.0f} s left" if left < 90 else f"about {left / 60:.0f} min left"


@require_GET
def jobs(request: HttpRequest) -> HttpResponseBase:
    """Render running, queued and failed jobs; finished ones if requested."""
    visibility = visibility_for_request(request)
    listing = Listing(request.GET, _columns(visibility), _FILTERS)
    listed = jobs_listed(**listing.chosen)
    if listing.wants_file:
        return listing.file(request, "jobs", listed)
    page = listing.page(listed, PER_PAGE)
    having = served()
    rows = [row_of(job, visibility, having) for job in page]
    context = {
        "listing": listing,
        "page": page,
        "rows": rows,
        "passing": any(row.job.status in (JobStatus.QUEUED, JobStatus.RUNNING) for row in rows),
        "may_act": role_of(request.user) is not Role.VIEWER,
    }
    return render(request, "console/jobs.html", context)


@require_POST
def job_act(request: HttpRequest, what: str) -> HttpResponse:
    """Cancel a job, or repeat a failed one; for operators."""
    user: Any = request.user
    try:
        require_role(user, Role.OPERATOR)
        text = request.POST.get("job", "")
        job = job_get(id=int(text) if text.isascii() and text.isdecimal() and len(text) < 16 else 0)
        if what == "cancel":
            services.cancel(user=user, job=job)
        else:
            services.retry_job(user=user, job=job)
        messages.success(request, f"job {job.pk}: {_ACTS[what]}")
    except EvaError as fault:
        messages.error(request, str(fault))
    return redirect(f"{reverse('jobs')}?{request.POST.get('query', '')}")


def row_of(job: Job, sight: Visibility, having: Served) -> Row:
    """Return a job as displayed; if it may reveal a hidden checkpoint, the row shows only that it exists.

    `having` are the queues that the running workers serve.
    """
    title, lacks, progress, cover = (
        KINDS.get(job.kind, job.kind),
        having.lacks(job),
        job.error or job.progress,
        cover_of(job, sight),
    )
    if cover is Cover.ALL:
        return Row(job, title, "a blind trial", "", Pace(), HIDDEN if progress else "", lacks, covered=True)
    about, address = _about(job)
    if cover is Cover.WORDS:
        return Row(job, title, about, address, Pace(), HIDDEN if progress else "", lacks)
    return Row(job, title, about, address, pace_of(job), progress, lacks)


def _about(job: Job) -> tuple[str, str]:
    """Return the job's subject and its address."""
    if "uuid" in job.args:
        uuid = str(job.args["uuid"])
        return f"episode {uuid[:8]}", reverse("replay", args=[uuid])
    if job.kind == DATASET:
        name = str(job.args.get("dataset") or job.args.get("to", "")).removeprefix("datasets/")
        return dataset_jobs.summarize_job(job).title, reverse("dataset", args=[name]) if name and is_name(
            name
        ) else ""
    if "plan" in job.args:
        plan = Plan.objects.filter(pk=job.args["plan"]).first()
        return (str(plan), reverse("result-plan", args=[plan.name, plan.version])) if plan else ("", "")
    if "preflight" in job.args:
        return "a checkpoint's server", reverse("preflight", args=[job.args["preflight"]])
    return "", ""


_FILTERS = (
    Filter("status", "State", JobStatus.choices, any="not done"),
    Filter("kind", "Kind", tuple(KINDS.items())),
)


def _columns(visibility: Visibility) -> tuple[Column, ...]:
    def shown(value: Callable[[Job], Any]) -> Callable[[Job], Any]:
        return lambda job: "" if cover_of(job, visibility) is Cover.ALL else value(job)

    return (
        Column("kind", "Job", ("kind", "key"), lambda job: job.kind),
        Column("key", "Key", cell=shown(lambda job: job.key), hidden=True),
        Column("about", "About"),
        Column("state", "State", ("status",), lambda job: job.status),
        Column("progress", "Progress"),
        Column("asked", "Asked for", ("created_at",), shown(lambda job: job.created_at), down=True),
        Column("finished", "Ended", ("finished_at",), shown(lambda job: job.finished_at), down=True),
        Column("acts", "What can be done", quiet=True),
    )
