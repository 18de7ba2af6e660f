"""Pages that play episodes, and the files they play."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import UUID

from asgiref.sync import sync_to_async
from django.core.paginator import Paginator
from django.http import HttpRequest, HttpResponse, JsonResponse
from django.http.response import HttpResponseBase
from django.shortcuts import redirect, render
from django.templatetags.static import static
from django.urls import reverse
from django.views.decorators.http import require_GET, require_POST

import robots
from evaweb.blinding import sight_for
from evaweb.episodes import selectors, services
from evaweb.episodes.curves import curves
from evaweb.episodes.exporting import CONTENT_TYPE, table_file, table_of
from evaweb.episodes.folders import THUMBNAIL, journal_folder, preview_folder, preview_video
from evaweb.episodes.models import Episode, EpisodeMode, EpisodeStatus
from evaweb.episodes.poses import poses
from evaweb.episodes.robot import looks_in
from evaweb.episodes.selectors import episode_get, stage_of
from evaweb.episodes.streaming import file_answer
from evaweb.errors import Conflict, EvaError, NotFound
from evaweb.roles import Role, require
from evaweb.stations.geometry import geometry
from evaweb.stations.models import Station
from runtime.recording.base import IMPORTED
from runtime.recording.files import RecordingError, read_document

PER_PAGE = 50
FILTERS = ("station", "mode", "status", "quality", "review", "words")


# --- pages ---------------------------------------------------------------------------------------------------


@require_GET
def replay_list(request: HttpRequest) -> HttpResponse:
    """All episodes, the newest first."""
    chosen = {name: request.GET.get(name, "").strip() for name in FILTERS}
    found = selectors.episode_list(**chosen, sight=sight_for(request))
    page = Paginator(found, PER_PAGE).get_page(request.GET.get("page"))
    rows = [(episode, stage_of(episode=episode)) for episode in page]
    context = {
        "page": page,
        "rows": rows,
        "chosen": chosen,
        "stations": Station.objects.all(),
        "statuses": EpisodeStatus.choices,
        "modes": EpisodeMode.choices,
        "qualities": [(key, words) for key, (words, _) in selectors.QUALITY.items()],
        "reviews": [(key, words) for key, (words, _) in selectors.REVIEW.items()],
        "narrowed": any(chosen.values()),
        "passing": any(stage.passing for _, stage in rows),
    }
    template = "episodes/rows.html" if request.headers.get("HX-Request") else "episodes/list.html"
    return render(request, template, context)


@require_GET
def replay(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """One episode: cameras, robot and curves on one clock."""
    episode = episode_get(uuid=uuid)
    stage = stage_of(episode=episode)
    context = {
        "episode": episode,
        "trial": selectors.trial_of(episode=episode),
        "stage": stage,
        "table": table_of(episode=episode),
        "config": replay_config(episode) | player() if stage.name == "ready" else None,
    }
    return render(request, "episodes/replay.html", context)


@require_GET
def stage(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Stage of an episode; tells a page that it can be played now."""
    episode = episode_get(uuid=uuid)
    found = stage_of(episode=episode)
    answer = render(request, "episodes/stage.html", {"episode": episode, "stage": found})
    if found.name == "ready":
        answer["HX-Refresh"] = "true"
    return answer


async def export(request: HttpRequest, uuid: UUID) -> HttpResponseBase:
    """The three streams as one table; POST has it made where it is not there."""
    episode = await _known(uuid)
    if request.method == "POST":
        return await sync_to_async(_export_asked)(request, episode)
    await sync_to_async(lambda: sight_for(request).require_episode(episode))()
    path = await sync_to_async(table_file)(uuid)
    return await file_answer(request, path, CONTENT_TYPE, path.name)


def _export_asked(request: HttpRequest, episode: Episode) -> HttpResponse:
    require(request.user, Role.OPERATOR)
    services.export_asked(episode=episode)
    return table(request, episode.uuid)


def table(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """State of the table, as a part of the episode's page that looks again by itself."""
    episode = episode_get(uuid=uuid)
    context = {"episode": episode, "table": table_of(episode=episode)}
    return render(request, "episodes/table.html", context)


@require_POST
def preview(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Ask for the videos anew."""
    require(request.user, Role.OPERATOR)
    services.preview_asked(episode=episode_get(uuid=uuid))
    return redirect("replay", uuid=uuid)


def player() -> dict[str, Any]:
    """Scripts that every page with a player needs, whatever it plays."""
    return {"viewer": static("meshcat/main.min.js"), "uplot": static("uplot/uPlot.esm.js")}


def replay_config(episode: Episode) -> dict[str, Any]:
    """Settings of an episode for the page's modules; a video's first picture is shown at its `start` [s]."""
    address = {
        name: reverse(f"episode-{name}", args=[episode.uuid]) for name in ("curves", "geometry", "poses")
    }
    videos = [
        {"camera": camera, "address": reverse("episode-video", args=[episode.uuid, camera]), "start": 0.0}
        for camera in episode.cameras
    ]
    if episode.kind == IMPORTED and episode.robot not in robots.names():
        called = f"calls its robot {episode.robot}" if episode.robot else "names no robot"
        address |= {"geometry": "", "why": f"the dataset {called}: import it with --robot"}
    return {**address, "videos": videos, "fps": episode.fps, "frames": episode.frames}


# --- files ---------------------------------------------------------------------------------------------------


async def video(request: HttpRequest, uuid: UUID, camera: str) -> HttpResponseBase:
    """The video of one camera, also in parts."""
    episode = await _known(uuid)
    if camera not in episode.cameras:
        raise NotFound(f"episode {uuid} has no camera {camera!r:.80}; it has {', '.join(episode.cameras)}")
    return await file_answer(request, preview_video(uuid, camera), "video/mp4")


async def thumbnail(request: HttpRequest, uuid: UUID) -> HttpResponseBase:
    """A picture from the middle of the episode."""
    await _known(uuid)
    return await file_answer(request, preview_folder(uuid) / THUMBNAIL, "image/jpeg")


async def _known(uuid: UUID) -> Episode:
    episode = await Episode.objects.select_related("trial").filter(uuid=uuid).afirst()
    if episode is None:
        raise NotFound(f"episode {uuid} does not exist in this lab")
    return episode


@require_GET
def episode_curves(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Joint curves and events, as one message of evaweb.binary_frames."""
    covered = sight_for(request).hides_episode(episode_get(uuid=uuid))
    return _message(lambda: curves(journal_folder(uuid), covered=covered))


@require_GET
def episode_geometry(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Geometry of the robot as it was then, for the 3D scene, as JSON."""
    episode_get(uuid=uuid)
    try:
        manifest = read_document(journal_folder(uuid) / "manifest.json")
    except RecordingError as error:
        raise Conflict(str(error)) from None
    robot = looks_in(manifest).robot
    groups = [group.name for group in robot.groups]
    return JsonResponse(geometry(robot.name, groups, simulated=False))


@require_GET
def episode_poses(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Poses of the robot's parts from row ?first= on, as one message of evaweb.binary_frames."""
    episode_get(uuid=uuid)
    first = request.GET.get("first", "0")
    if not (first.isascii() and first.isdecimal()) or len(first) > 9:
        raise EvaError(f"first = {first!r:.40}; allowed: a whole number from 0")
    return _message(lambda: poses(journal_folder(uuid), int(first)))


def _message(make: Callable[[], bytes]) -> HttpResponse:
    try:
        content = make()
    except RecordingError as error:
        raise Conflict(str(error)) from None
    return HttpResponse(content, content_type="application/octet-stream")
