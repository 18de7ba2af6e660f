"""Pages that replay episodes of datasets, and several episodes side by side, and the media they use."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from asgiref.sync import sync_to_async
from django.http import HttpRequest, HttpResponse, JsonResponse
from django.http.response import HttpResponseBase
from django.shortcuts import render
from django.views.decorators.http import require_GET

import robots
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import Conflict, EvaError, NotFound
from evaweb.datasets import playback
from evaweb.datasets.dataset_orders import full_name
from evaweb.datasets.playback import PlayedEpisode, as_recording
from evaweb.datasets.replay_sources import dataset_config, open_dataset_episode, resolve_entry
from evaweb.datasets.robot_replay import (
    SPACES,
    TAIL_S,
    make_offer,
    playable_episode,
)
from evaweb.datasets.still_images import still_image
from evaweb.episodes.curves import curve_streams
from evaweb.episodes.manifest_robot import drawn_robot_for
from evaweb.episodes.models import Episode
from evaweb.episodes.poses import pose_streams
from evaweb.episodes.streaming import file_answer
from evaweb.episodes.views import player
from evaweb.stations.geometry import scene_geometry
from evaweb.stations.models import Station
from runtime.core.sentences import Pattern
from runtime.recording.files import RecordingError

_EPISODES_BESIDE_EACH_OTHER_ALLOWED = Pattern(
    "datasets.replaying.episodes_beside_each_other_allowed",
    "{count} episodes beside each other; allowed: at most {most}",
)
_PICTURES_COLUMN_THERE_NO_VIDEO = Pattern(
    "datasets.replaying.pictures_column_there_no_video",
    "the pictures of {camera} are in a column: there is no video of them",
)
_ROW_EPISODE_HAS_ROWS_0 = Pattern(
    "datasets.replaying.row_episode_has_rows_0",
    "row {row}: the episode has rows 0 to {frames}",
)
_ALLOWED_WHOLE_NUMBER_FROM_0 = Pattern(
    "datasets.replaying.allowed_whole_number_from_0",
    "{name} = {given!r:.40}; allowed: a whole number from 0",
)

Result = TypeVar("Result")
MOST = 6  # episodes side by side
_TYPES = {".mp4": "video/mp4", ".mkv": "video/x-matroska", ".webm": "video/webm", ".mov": "video/quicktime"}


# --- pages ---------------------------------------------------------------------------------------------------


@require_GET
def replay(request: HttpRequest, name: str, index: int) -> HttpResponse:
    """Show one episode of a dataset: cameras, robot and curves on one clock."""
    episode = _episode(request, name, index)
    context = {
        "episode": episode,
        "short": episode.name.removeprefix("datasets/"),
        "recording": _recording(episode),
        "cameras": list(episode.cameras),
        "last": len(episode.dataset.episodes) - 1,
        "robots": robots.robot_names(),
        "config": dataset_config(episode) | player(),
    }
    return render(request, "datasets/replay.html", context)


@require_GET
def side_by_side(request: HttpRequest) -> HttpResponse:
    """Show several episodes on one clock; each ?show= names one, see evaweb.datasets.replay_sources."""
    names = list(dict.fromkeys(name.strip() for name in request.GET.getlist("show") if name.strip()))
    if len(names) > MOST:
        raise EvaError(_EPISODES_BESIDE_EACH_OTHER_ALLOWED(count=len(names), most=MOST))
    entries, problems = [], []
    for name in names:
        try:
            entries.append(resolve_entry(request, name))
        except EvaError as error:
            problems.append(str(error))
    config = player() | {
        "episodes": [{"name": entry.name, "title": entry.title, **entry.config} for entry in entries]
    }
    context = {"shown": entries, "problems": problems, "config": config, "most": MOST}
    return render(request, "datasets/side_by_side.html", context)


@require_GET
def on_robot(request: HttpRequest) -> HttpResponse:
    """Show which stations can play an episode, and what they would send."""
    recorded = playable_episode(request.GET.get("show", ""), request.GET.get("robot", ""))
    space = request.GET.get("space", "joint")
    offers = [make_offer(recorded, station, space) for station in Station.objects.filter(active=True)]
    context = {
        "recorded": recorded,
        "offers": sorted(offers, key=lambda one: (bool(one.differences), one.station.name)),
        "space": space,
        "spaces": SPACES,
        "robot": request.GET.get("robot", ""),
        "after_s": TAIL_S,
    }
    return render(request, "datasets/on_robot.html", context)


# --- files ---------------------------------------------------------------------------------------------------


async def video(request: HttpRequest, name: str, index: int, camera: str) -> HttpResponseBase:
    """Return the video that contains a camera's images, also in ranges; it may contain other episodes."""
    episode = await sync_to_async(_episode)(request, name, index)
    span = episode.video(camera)
    if span is None:
        raise NotFound(_PICTURES_COLUMN_THERE_NO_VIDEO(camera=camera))
    kind = _TYPES.get(span.path.suffix.lower(), "application/octet-stream")
    return await file_answer(request, span.path, kind)


@require_GET
def picture(request: HttpRequest, name: str, index: int, camera: str) -> HttpResponse:
    """Return image ?row= of a camera whose images are in a column."""
    episode = _episode(request, name, index)
    row = _number(request, "row")
    if row >= episode.frames:
        raise NotFound(_ROW_EPISODE_HAS_ROWS_0(row=row, frames=episode.frames - 1))
    content, kind = _or_conflict(lambda: still_image(episode, camera, row))
    return HttpResponse(content, content_type=kind)


@require_GET
def curves(request: HttpRequest, name: str, index: int) -> HttpResponse:
    """Return joint curves, and action streams if there is a sidecar, as one message of evaweb.core.binary_frames."""
    episode = _episode(request, name, index)
    recording = _recording(episode)
    covered = recording is not None and visibility_for_request(request).hides_episode(recording)
    return _binary_response(lambda: curve_streams(as_recording(episode), covered=covered))


@require_GET
def geometry_json(request: HttpRequest, name: str, index: int) -> HttpResponse:
    """Return the geometry of the robot for the 3D scene, as JSON."""
    episode = _episode(request, name, index)
    recording = _or_conflict(lambda: as_recording(episode))
    robot = drawn_robot_for(recording.manifest).robot
    return JsonResponse(scene_geometry(robot.name, [group.name for group in robot.groups]))


@require_GET
def poses(request: HttpRequest, name: str, index: int) -> HttpResponse:
    """Return the poses of the robot's parts from row ?first= on, as one message of evaweb.core.binary_frames."""
    episode = _episode(request, name, index)
    first = _number(request, "first")
    return _binary_response(lambda: pose_streams(as_recording(episode), first))


@require_GET
def segments(request: HttpRequest, name: str, index: int) -> HttpResponse:
    """Return the annotations and reviews in the dataset's sidecars, as JSON."""
    episode = _episode(request, name, index)
    document = _or_conflict(
        lambda: {"segments": playback.annotations(episode), "reviews": playback.reviews(episode)}
    )
    return JsonResponse(document)


def _episode(request: HttpRequest, name: str, index: int) -> PlayedEpisode:
    return open_dataset_episode(full_name(name), index, request.GET.get("robot", ""))


def _recording(episode: PlayedEpisode) -> Episode | None:
    """Return the lab's own recording of the episode, None if the database has none."""
    if not episode.uuid:
        return None
    return Episode.objects.select_related("trial").filter(uuid=episode.uuid).first()


def _number(request: HttpRequest, name: str) -> int:
    text = request.GET.get(name, "0")
    if not (text.isascii() and text.isdecimal()) or len(text) > 9:
        raise EvaError(_ALLOWED_WHOLE_NUMBER_FROM_0(name=name, given=text))
    return int(text)


def _or_conflict(make: Callable[[], Result]) -> Result:
    try:
        return make()
    except RecordingError as error:
        raise Conflict(str(error)) from None


def _binary_response(make: Callable[[], bytes]) -> HttpResponse:
    return HttpResponse(_or_conflict(make), content_type="application/octet-stream")
