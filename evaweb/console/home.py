"""Home page: tasks of one user, current activity in the lab, and alarms."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from django.conf import settings
from django.db.models import Q
from django.urls import reverse
from django.utils import timezone

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import Visibility
from evaweb.console.feed import feeds
from evaweb.console.views_jobs import Row, row_of
from evaweb.episodes.verification import unverified
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.selectors import jobs_failed
from evaweb.jobs.workers import served
from evaweb.plans.models import PlanState
from evaweb.results import selectors as results
from evaweb.results.ratings.result_visibility import sealed_reason
from evaweb.results.selectors import PlanRow
from evaweb.reviews.selectors import unreviewed_episodes
from evaweb.stations.models import LeaseRequest, Station
from evaweb.trials.models import Trial, TrialStatus, VoidRequest
from evaweb.trials.selectors import UNFINISHED
from evaweb.trials.voids import can_answer_void

MOST = 5  # items per kind
FULL = 0.10  # share of free disk space below which there is an alarm
_OLD_S = 10.0  # image age at which a camera counts as lost
WAITED = timedelta(minutes=2)  # waiting time of a job, while none runs, before there is an alarm
_VOIDS = 20  # void requests examined; each needs a check whether this user may answer it


@dataclass(frozen=True, slots=True)
class Item:
    """Task or alarm: a sentence, the address where it is handled, and the text of the link. `grave` marks a fault."""

    text: str
    address: str
    go: str
    grave: bool = False


@dataclass(frozen=True, slots=True)
class PlanNow:
    """Running plan on the home page.

    `evidence` is the address of its evidence, or "" if this user may not see it; then `sealed` is the reason.
    """

    row: PlanRow
    evidence: str
    sealed: str


@dataclass(frozen=True, slots=True)
class Now:
    """All contents of the home page for one user."""

    work: list[Item]
    alarms: list[Item]
    plans: list[PlanNow]
    jobs: list[Row]


def now(*, user: Any, sight: Visibility) -> Now:
    """Return the current contents; the number of queries does not grow with the size of the lab."""
    under_way = Job.objects.filter(status__in=(JobStatus.RUNNING, JobStatus.QUEUED)).select_related(
        "cancelled_by"
    )
    jobs = under_way.order_by("-status", "created_at")[:MOST]  # running first, then queued
    having = served()
    running = results.plan_rows(results.plan_list(PlanState.FROZEN)[:MOST])
    return Now(
        work=[] if role_of(user) is Role.VIEWER else list(_work(user)),
        alarms=list(alarms()),
        plans=[_plan(row, user, sight) for row in running],
        jobs=[row_of(job, sight, having) for job in jobs],
    )


def _plan(row: PlanRow, user: Any, visibility: Visibility) -> PlanNow:
    sealed = sealed_reason(row.plan, user, visibility)
    address = reverse("result-evidence", args=[row.plan.name, row.plan.version])
    return PlanNow(row, "" if sealed or not row.counted else address, sealed)


# --- of this user --------------------------------------------------------------------------------------------


def _work(user: Any) -> Iterator[Item]:
    waiting = Q(status__in=(*UNFINISHED, TrialStatus.INTERRUPTED))
    begun = Trial.objects.filter(waiting, operator=user).select_related("scene", "position", "station")
    for trial in begun.order_by("-pk")[:MOST]:
        title = f"Trial {trial.pk}, {trial.scene.title}, position {trial.position.number}: {trial.get_status_display()}"
        if trial.status in (TrialStatus.ENDED, TrialStatus.INTERRUPTED):
            yield Item(title, reverse("result-trial", args=[trial.pk]), "Score it")
        else:
            yield Item(title, reverse("station-eval", args=[trial.station.name]), f"At {trial.station}")
    requests = VoidRequest.objects.filter(answer="").select_related("trial", "by").order_by("at")[:_VOIDS]
    for request in [request for request in requests if can_answer_void(request.trial, user)][:MOST]:
        text = (
            f"{request.by.get_username()} asks for the void of trial {request.trial_id}: {request.reason:.80}"
        )
        yield Item(text, reverse("result-trial", args=[request.trial_id]), "Answer")
    for request in _requests(user):
        text = f"{request.user.get_username()} asks for {request.station}, which you command"
        yield Item(text, reverse("station-eval", args=[request.station.name]), "Answer")
    waiting = unreviewed_episodes()
    if (first := waiting.values_list("uuid", flat=True).first()) is not None:
        count = waiting.order_by().count()
        text = f"{count} episode{'s are' if count > 1 else ' is'} waiting for a review"
        yield Item(text, reverse("replay", args=[first]), "Review")


def _requests(user: Any) -> list[LeaseRequest]:
    mine = LeaseRequest.objects.filter(
        answer=LeaseRequest.Answer.OPEN, station__leases__ended_at=None, station__leases__user=user
    )
    return list(mine.select_related("station", "user").distinct()[:MOST])


# --- of the lab ----------------------------------------------------------------------------------------------


def alarms() -> Iterator[Item]:
    """Yield the alarms of the whole lab."""
    for station in Station.objects.filter(active=True).order_by("name"):
        feed = feeds.get(station.name)
        stands = feed.state.get("state_is", {}) if feed.link.ok else {}
        if not feed.link.ok:
            yield Item(
                feed.link.reason, reverse("station-debug", args=[station.name]), "Its page", grave=True
            )
        elif (
            stands.get("tone") == "danger"
        ):  # its cause may reveal the checkpoint: only the station's page shows it
            text = f"{station} is {stands['label']}"
            yield Item(text, reverse("station-eval", args=[station.name]), "Its page", grave=True)
        if lost := _cameras_lost(feed.state) if feed.link.ok else "":
            text = f"{station} has no picture of {lost}"
            yield Item(text, reverse("station-debug", args=[station.name]), "Its page", grave=True)
    yield from _disk()
    yield from _recordings()
    failed = jobs_failed().count()
    if failed:
        text = f"{failed} job{'s' if failed > 1 else ''} failed"
        yield Item(text, f"{reverse('jobs')}?status=failed", "Look at them", grave=True)
    waits = Job.objects.filter(
        status=JobStatus.QUEUED, created_at__lt=timezone.now() - WAITED, not_before=None
    )
    having, waiting_kinds = served(), waits.order_by("kind").values_list("kind", "queue").distinct()
    lacking = list(
        dict.fromkeys(filter(None, (having.lacks_for(kind, queue) for kind, queue in waiting_kinds)))
    )
    for text in lacking:
        yield Item(text, reverse("jobs"), "Jobs", grave=True)
    if not lacking and waiting_kinds and not Job.objects.filter(status=JobStatus.RUNNING).exists():
        text = "Jobs are waiting, but no worker takes them: does one hang?"
        yield Item(text, reverse("jobs"), "Jobs", grave=True)


def _cameras_lost(state: Mapping[str, Any]) -> str:
    """Return the names of the cameras whose newest image is too old, joined by commas.

    "" if there is none, or if the robot's joints do not arrive either: in that case the cause is not the cameras.
    """
    ages = dict(state.get("link", {}).get("ages", {}))
    joints = ages.pop("joints", None)
    if joints is None or not joints < _OLD_S:
        return ""
    return ", ".join(name for name, age in ages.items() if age is None or not age < _OLD_S)


def _disk() -> Iterator[Item]:
    total, _, free = shutil.disk_usage(settings.DATA_DIR)
    if free < FULL * total:
        text = f"The disk of the lab is nearly full: {free / 1e9:.1f} GB of {total / 1e9:.0f} GB free"
        yield Item(text, reverse("replay-list"), "Recordings", grave=True)


def _recordings() -> Iterator[Item]:
    damaged, late = unverified()
    listed = reverse("replay-list")
    if damaged:
        text = f"{damaged} recording{'s are' if damaged > 1 else ' is'} damaged"
        yield Item(text, f"{listed}?quality=damaged", "Look at them", grave=True)
    if late:
        text = f"{late} recording{'s were' if late > 1 else ' was'} not verified in time"
        yield Item(text, reverse("jobs"), "Jobs")
