"""Episodes: the database rows of the recordings."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from asgiref.sync import async_to_sync
from django.http import HttpRequest
from ninja import Field, Query, Router, Schema, Status

from evaweb.accounts.roles import Role, require_role
from evaweb.api.jobs import JobOut
from evaweb.api.responses import FAILURES, Page, Paging
from evaweb.blinding.visibility import Visibility, visibility_for_request
from evaweb.collect.selectors import PUBLISHED_RESULTS, accepted_demonstrations
from evaweb.core.errors import Conflict, NotFound
from evaweb.episodes import services
from evaweb.episodes.exports import MCAP, TABLE, ExportFormat, export_file
from evaweb.episodes.models import Episode, EpisodeMode, EpisodeStatus
from evaweb.episodes.streaming import file_answer
from evaweb.stations.selectors import station_get
from evaweb.trials.models import TrialStatus
from runtime.core.sentences import Pattern
from runtime.interop.mcap_export import Pictures

_EPISODE_STILL_BEING_RECORDED_PUBLISHED = Pattern(
    "api.episodes.episode_still_being_recorded_published",
    "episode {uuid} is still being recorded: it is published when it is closed",
)
_EPISODE_NOT_ACCEPTED_HAS_LABELLED = Pattern(
    "api.episodes.episode_not_accepted_has_labelled",
    "episode {uuid} is not accepted: it has to be labelled {published_results}, not discarded, and "
    "failed by no review",
)
_EPISODE_SIMULATED_ROBOT_NO_DATASET = Pattern(
    "api.episodes.episode_simulated_robot_no_dataset",
    "episode {uuid} is of a simulated robot: no dataset ever holds it",
)
_EPISODE_DOES_NOT_EXIST = Pattern("api.episodes.episode_does_not_exist", "episode {uuid} does not exist")

router = Router(tags=["episodes"])
_WITH = ("station", "trial__checkpoint", "trial__handout", "trial__verdict", "demonstration")


class DamageOut(Schema):
    """One file that differs from the file as it was recorded.

    `rows` and `times` [s] are stretches of the recording that are affected: the first and the last row or time of each.
    """

    file: str
    what: str
    rows: list[tuple[int, int]]
    times: list[tuple[float, float]]
    text: str


class EpisodeOut(Schema):
    """One recorded run or demonstration; `trial` is the id of the trial that it was recorded for.

    `result` is success, partial (of demonstrations) or fail; "" if it was not rated. `away_since` is the time since
    which the closed recording is only on its station's computer; null if it is here. `archived_at` is the time since
    which its recorded videos are in the lab's store; null if they are not.

    While its checkpoint is hidden from the caller, the trial's code replaces the checkpoint's name, and every other
    field that could reveal it is empty.
    """

    uuid: UUID
    station: str
    trial: int | None
    result: str
    status: EpisodeStatus
    reason: str
    kind: str
    mode: str
    strategy: str
    task: str
    robot: str
    checkpoint: str
    operator: str
    cameras: list[str]
    fps: float | None
    frames: int
    duration_s: float | None
    started_at: datetime | None
    previewed_at: datetime | None
    dataset: str
    dataset_index: int | None
    published_at: datetime | None
    damage: list[DamageOut]
    verified_at: datetime | None
    away_since: datetime | None
    archived_at: datetime | None
    tags: list[str]

    @staticmethod
    def of(episode: Episode, sight: Visibility) -> dict[str, Any]:
        """Return the episode with the names of its station and its trial."""
        own = [name for name in EpisodeOut.model_fields if name not in ("station", "trial", "result", "tags")]
        trial, hidden = getattr(episode, "trial", None), sight.hides_episode(episode)
        return {
            **{name: getattr(episode, name) for name in own},
            "station": episode.station.name,
            "trial": trial.pk if trial else None,
            "result": _result(episode, trial),
            "tags": sight.tags_of(episode),
            "checkpoint": sight.policy_of(episode) if hidden else episode.checkpoint,
            "strategy": "" if hidden else episode.strategy,
            "reason": sight.redact_text(episode.reason) if hidden else episode.reason,
        }


def _result(episode: Episode, trial: Any) -> str:
    demonstration = getattr(episode, "demonstration", None)
    if demonstration is not None:
        return str(demonstration.result)
    counts = trial is not None and trial.status == TrialStatus.SCORED and trial.verdict is not None
    return ("success" if trial.verdict.success else "fail") if counts else ""


class EpisodeDetail(EpisodeOut):
    """An episode with the control loop's final figures and its smoothness (SPARC; null if unknown)."""

    configuration_hash: str
    control: dict[str, Any]
    policy: dict[str, Any]
    smoothness: float | None
    smoothness_commanded: float | None
    smoothness_detail: dict[str, Any] | None

    @staticmethod
    def of(episode: Episode, sight: Visibility) -> dict[str, Any]:
        """Return the episode with all details."""
        hidden = sight.hides_episode(episode)
        return {
            **EpisodeOut.of(episode, sight),
            "configuration_hash": "" if hidden else episode.configuration_hash,
            "control": {} if hidden else episode.control,
            "policy": {} if hidden else episode.policy,
            "smoothness": None if hidden else episode.smoothness,
            "smoothness_commanded": None if hidden else episode.smoothness_commanded,
            "smoothness_detail": None if hidden else episode.smoothness_detail,
        }


class Filters(Schema):
    """Filters of episodes."""

    station: str = ""
    mode: EpisodeMode | None = None
    status: EpisodeStatus | None = None
    dataset: Annotated[str, Field(description="Relative to the data folder")] = ""
    damaged: bool | None = None
    tag: str = ""


@router.get("", response={200: Page[EpisodeOut], **FAILURES}, summary="Episodes", url_name="episodes")
def episodes(request: HttpRequest, filters: Query[Filters], paging: Query[Paging]) -> Any:
    """Return the episodes, newest first."""
    visibility = visibility_for_request(request)
    rows = Episode.objects.select_related(*_WITH).prefetch_related("tags")
    rows = rows.order_by("-started_at", "-created_at", "pk")
    if filters.station:
        rows = rows.filter(station=station_get(name=filters.station))
    if filters.damaged is not None:
        rows = rows.exclude(damage=[]) if filters.damaged else rows.filter(damage=[])
    if filters.tag:
        rows = rows.filter(tags__words=filters.tag) if not visibility.named_in(filters.tag) else rows.none()
    lookups = {
        "mode": filters.mode and filters.mode.value,
        "status": filters.status and filters.status.value,
        "dataset": filters.dataset,
    }
    return paging.page(
        rows.filter(**{name: value for name, value in lookups.items() if value}),
        EpisodeOut,
        visibility,
    )


@router.get(
    "/{uuid:uuid}", response={200: EpisodeDetail, **FAILURES}, summary="One episode", url_name="episode"
)
def episode(request: HttpRequest, uuid: UUID) -> Any:
    """Return an episode by its uuid."""
    return EpisodeDetail.of(_found(uuid), visibility_for_request(request))


_BINARY = {"schema": {"type": "string", "format": "binary"}}


def _file_of(wanted: ExportFormat, words: str) -> dict[str, Any]:
    """Return the part of the OpenAPI document that describes an exported file."""
    return {"responses": {200: {"description": words, "content": {wanted.content_type: _BINARY}}}}


@router.get(
    "/{uuid:uuid}/export",
    response=FAILURES,
    summary="Its three streams as one table",
    url_name="episode-export",
    openapi_extra=_file_of(TABLE, "A parquet file"),
)
def episode_export(request: HttpRequest, uuid: UUID) -> Any:
    """Return raw, smoothed and executed actions step by step; the file's metadata hold manifest and outcome."""
    return _export_answer(request, uuid, TABLE)


@router.post(
    "/{uuid:uuid}/export",
    response={202: JobOut, **FAILURES},
    summary="Have the table made",
    url_name="episode-export-asked",
)
def request_export(request: HttpRequest, uuid: UUID) -> Any:
    """Queue the export of an episode that its station has not exported. The job reports the progress."""
    return _request_export(request, uuid, TABLE)


@router.get(
    "/{uuid:uuid}/mcap",
    response=FAILURES,
    summary="It as one MCAP file",
    url_name="episode-mcap",
    openapi_extra=_file_of(MCAP["video"], "An MCAP file"),
)
def episode_mcap(request: HttpRequest, uuid: UUID, pictures: Pictures = "video") -> Any:
    """Return joints, actions, events and pictures as messages of ROS 2, for Foxglove, Rerun and ROS 2.

    `pictures`: `video` for Foxglove, `image-h264` for Rerun, `jpeg` for all programs. The file is kept for a day.
    """
    return _export_answer(request, uuid, MCAP[pictures])


@router.post(
    "/{uuid:uuid}/mcap",
    response={202: JobOut, **FAILURES},
    summary="Have the MCAP file made",
    url_name="episode-mcap-asked",
)
def request_mcap(request: HttpRequest, uuid: UUID, pictures: Pictures = "video") -> Any:
    """Queue the export of an episode as MCAP. The job reports the progress."""
    return _request_export(request, uuid, MCAP[pictures])


@router.post(
    "/{uuid:uuid}/publish",
    response={202: JobOut, **FAILURES},
    summary="Have it published",
    url_name="episode-publish-asked",
)
def episode_publish_asked(request: HttpRequest, uuid: UUID) -> Any:
    """Write the episode into its dataset, or update it there with its current score. Requires an operator.

    A demonstration is published under the rules of its session: it must be labelled success or partial, and be neither
    discarded nor failed by a review.
    """
    require_role(request.auth, Role.OPERATOR)
    episode = _found(uuid)
    if episode.status == EpisodeStatus.RECORDING:
        raise Conflict(_EPISODE_STILL_BEING_RECORDED_PUBLISHED(uuid=uuid))
    demonstration = getattr(episode, "demonstration", None)
    if demonstration is not None and not _accepted(demonstration):
        raise Conflict(
            _EPISODE_NOT_ACCEPTED_HAS_LABELLED(uuid=uuid, published_results=" or ".join(PUBLISHED_RESULTS))
        )
    job = services.request_publish(episode=episode)
    if job is None:
        raise Conflict(_EPISODE_SIMULATED_ROBOT_NO_DATASET(uuid=uuid))
    return Status(202, JobOut.of(job, visibility_for_request(request)))


def _accepted(demonstration: Any) -> bool:
    fits = accepted_demonstrations(session=demonstration.session, results=PUBLISHED_RESULTS)
    return fits.filter(pk=demonstration.pk).exists()


def _export_answer(request: HttpRequest, uuid: UUID, wanted: ExportFormat) -> Any:
    episode = _found(uuid)
    visibility_for_request(request).require_episode(episode)
    path = export_file(episode.uuid, wanted)
    return async_to_sync(file_answer)(request, path, wanted.content_type, path.name)


def _request_export(request: HttpRequest, uuid: UUID, wanted: ExportFormat) -> Any:
    require_role(request.auth, Role.OPERATOR)
    job = services.request_export(episode=_found(uuid), wanted=wanted)
    return Status(202, JobOut.of(job, visibility_for_request(request)))


def _found(uuid: UUID) -> Episode:
    episode = Episode.objects.select_related(*_WITH).filter(pk=uuid).first()
    if episode is None:
        raise NotFound(_EPISODE_DOES_NOT_EXIST(uuid=uuid))
    return episode
