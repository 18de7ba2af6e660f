"""Collecting sessions: open, close, resume, publish; their episodes, and the worker's jobs for them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from django.http import HttpRequest
from ninja import Field, Query, Router, Schema, Status

from evaweb.api.jobs import JobOut
from evaweb.api.responses import (
    FAILURES,
    Body,
    Page,
    Paging,
)
from evaweb.blinding.visibility import Visibility, visibility_for_request
from evaweb.collect import selectors, services
from evaweb.collect.models import CollectSession
from evaweb.collect.work import QueueItem, session_queue
from evaweb.stations.selectors import station_get

router = Router(tags=["collecting"])
_Target = Annotated[
    int | None, Field(description="Episodes that are wanted, null for as many as there will be")
]


class SessionOut(Schema):
    """One task demonstrated at one station for one dataset; `closed_at` is null while the session is open."""

    uuid: UUID
    station: str
    dataset: str
    task: str
    operator: str
    target: int | None
    opened_at: datetime
    closed_at: datetime | None

    @staticmethod
    def of(session: CollectSession) -> dict[str, Any]:
        """Return the session with names of station and operator."""
        plain = ("uuid", "dataset", "task", "target", "opened_at", "closed_at")
        names = {"station": session.station.name, "operator": session.operator.get_username()}
        return {**{name: getattr(session, name) for name in plain}, **names}


class CountsOut(Schema):
    """Numbers of episodes of a session.

    `saved` are complete and not discarded; they are the sum of `success`, `partial`, `fail` and `unlabelled`. `cut`
    ended
    in a fault.
    """

    saved: int
    success: int
    partial: int
    fail: int
    unlabelled: int
    discarded: int
    cut: int
    published: int


class SessionEventOut(Schema):
    """One event of a session."""

    kind: str
    text: str
    by: str
    at: datetime


class DemonstrationOut(Schema):
    """An episode of the session with its newest label, "" if it has none."""

    episode: UUID
    status: str
    frames: int
    duration_s: float | None
    started_at: datetime | None
    result: str
    note: str
    discarded: bool
    dataset: str
    dataset_index: int | None


class SessionDetail(SessionOut):
    """A session with set-up, counts, history and episodes (newest first).

    `folder` is that of its dataset; `version` is "" if the dataset is new.
    """

    setup: dict[str, Any]
    counts: CountsOut
    folder: str
    version: str
    events: list[SessionEventOut]
    episodes: list[DemonstrationOut]

    @staticmethod
    def of(session: CollectSession) -> dict[str, Any]:
        """Return the session with all details."""
        dataset = selectors.dataset_of(session=session)
        return {
            **SessionOut.of(session),
            "setup": session.setup,
            "counts": selectors.session_counts(session=session),
            "folder": dataset.name,
            "version": dataset.version,
            "events": [
                {"kind": event.kind, "text": event.text, "by": event.by.get_username(), "at": event.at}
                for event in session.events.select_related("by")
            ],
            "episodes": [
                {
                    **{name: getattr(demonstration, name) for name in ("result", "note", "discarded")},
                    **{
                        name: getattr(demonstration.episode, name)
                        for name in (
                            "status",
                            "frames",
                            "duration_s",
                            "started_at",
                            "dataset",
                            "dataset_index",
                        )
                    },
                    "episode": demonstration.pk,
                }
                for demonstration in selectors.demonstrations_of(session=session)
            ],
        }


class SessionIn(Body):
    """Task to be demonstrated; with `dataset` "" the deployment's dataset is used."""

    task: str
    dataset: str = ""
    target: _Target = None


class TargetIn(Body):
    """Number of episodes wanted."""

    target: _Target


class PublishIn(Body):
    """Results to be published, and the version of a new dataset ("" for the default)."""

    results: Annotated[
        list[Literal["success", "partial", "fail"]],
        Field(default_factory=lambda: list(selectors.PUBLISHED_RESULTS)),
    ]
    version: str = ""


class QueuedOut(JobOut):
    """A job that has not finished, with its remaining time [s] if known."""

    episode: UUID
    left_s: float | None

    @staticmethod
    def of(item: QueueItem, sight: Visibility) -> dict[str, Any]:
        """Return the job with the queue's additional facts."""
        return {**JobOut.of(item.job, sight), "episode": item.episode, "left_s": item.left_s}


class QueueOut(Schema):
    """Failed, running and waiting jobs of a session's episodes; `left_s` is the estimated time until none runs or
    waits.
    """

    done: int
    total: int
    left_s: float | None
    items: list[QueuedOut]


@router.get(
    "/sessions", response={200: Page[SessionOut], **FAILURES}, summary="Sessions", url_name="sessions"
)
def sessions(
    request: HttpRequest,
    paging: Query[Paging],
    station: str = "",
    dataset: str = "",
    open: bool | None = None,
) -> Any:
    """Return the sessions, newest first."""
    return paging.page(selectors.session_list(station=station, dataset=dataset, is_open=open), SessionOut)


@router.get(
    "/sessions/{uuid:uuid}",
    response={200: SessionDetail, **FAILURES},
    summary="One session",
    url_name="session",
)
def session(request: HttpRequest, uuid: UUID) -> Any:
    """Return a session with its episodes and history."""
    return SessionDetail.of(selectors.session_get(uuid=uuid))


@router.get(
    "/sessions/{uuid:uuid}/queue",
    response={200: QueueOut, **FAILURES},
    summary="Work for its episodes",
    url_name="session-queue",
)
def queue(request: HttpRequest, uuid: UUID) -> Any:
    """Return the jobs of a session: quality, previews, tables, publication.

    `POST /jobs/ID/retry` retries a failed one.
    """
    work = session_queue(session=selectors.session_get(uuid=uuid))
    return {
        "done": work.done,
        "total": work.total,
        "left_s": work.left_s,
        "items": [QueuedOut.of(item, visibility_for_request(request)) for item in work.items],
    }


@router.post(
    "/stations/{name}/sessions",
    response={201: SessionOut, **FAILURES},
    summary="Open a session",
    url_name="session-open",
)
def open_session(request: HttpRequest, name: str, given: SessionIn) -> Any:
    """Open a session with the station's present set-up.

    Requires an operator, and that no other user commands the station.
    """
    session = services.open_session(user=request.auth, station=station_get(name=name), **given.model_dump())
    return Status(201, SessionOut.of(session))


@router.post(
    "/sessions/{uuid:uuid}/close",
    response={200: SessionOut, **FAILURES},
    summary="Close",
    url_name="session-close",
)
def close_session(request: HttpRequest, uuid: UUID) -> Any:
    """Close a session; it can be resumed."""
    return SessionOut.of(services.close_session(user=request.auth, session=selectors.session_get(uuid=uuid)))


@router.post(
    "/sessions/{uuid:uuid}/resume",
    response={200: SessionOut, **FAILURES},
    summary="Resume",
    url_name="session-resume",
)
def resume_session(request: HttpRequest, uuid: UUID) -> Any:
    """Resume a session; refused with every difference if the station's set-up has changed."""
    return SessionOut.of(services.resume_session(user=request.auth, session=selectors.session_get(uuid=uuid)))


@router.post(
    "/sessions/{uuid:uuid}/target",
    response={200: SessionOut, **FAILURES},
    summary="Target",
    url_name="session-target",
)
def set_target(request: HttpRequest, uuid: UUID, given: TargetIn) -> Any:
    """Set the number of episodes wanted."""
    session = selectors.session_get(uuid=uuid)
    return SessionOut.of(services.set_session_target(user=request.auth, session=session, target=given.target))


@router.post(
    "/sessions/{uuid:uuid}/publish",
    response={202: list[JobOut], **FAILURES},
    summary="Publish its episodes",
    url_name="session-publish",
)
def publish(request: HttpRequest, uuid: UUID, given: PublishIn) -> Any:
    """Publish the accepted episodes that are in no dataset yet; returns the jobs."""
    session = selectors.session_get(uuid=uuid)
    jobs = services.publish_session(user=request.auth, session=session, **given.model_dump())
    return Status(202, [JobOut.of(job, visibility_for_request(request)) for job in jobs])
