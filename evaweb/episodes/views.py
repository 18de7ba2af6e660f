"""Pages that play episodes, and the media they use."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TypeVar
from uuid import UUID

from asgiref.sync import sync_to_async
from django.http import HttpRequest, HttpResponse, HttpResponseRedirect, JsonResponse
from django.http.response import HttpResponseBase
from django.shortcuts import redirect, render
from django.templatetags.static import static
from django.urls import reverse
from django.views.decorators.http import require_GET, require_POST

import robots
from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import Conflict, EvaError, NotFound
from evaweb.episodes import listed, selectors, services
from evaweb.episodes.bench import bench_course
from evaweb.episodes.curves import curve_message
from evaweb.episodes.exports import FORMATS, export_file, export_format, export_of
from evaweb.episodes.folders import THUMBNAIL, journal_folder, preview_folder, preview_sheet
from evaweb.episodes.manifest_robot import drawn_robot_for
from evaweb.episodes.models import Episode
from evaweb.episodes.poses import pose_message
from evaweb.episodes.selectors import episode_get
from evaweb.episodes.sheets import Grid
from evaweb.episodes.streaming import file_answer
from evaweb.episodes.videos import TYPE, video_address, video_file
from evaweb.serving.lists import Listing
from evaweb.stations.geometry import scene_geometry
from runtime.core.sentences import Pattern
from runtime.recording.base import IMPORTED
from runtime.recording.files import RecordingError, read_json
from runtime.recording.layout import simulated_bench

_SHOWN_EXPORTS = ("table", "mcap-video", "mcap-image-h264")  # JPEG is for programs that know neither

_EPISODE_DOES_NOT_EXIST_THIS = Pattern(
    "episodes.views.episode_does_not_exist_this",
    "episode {uuid} does not exist in this lab",
)
_EPISODE_HAS_NO_CAMERA_HAS = Pattern(
    "episodes.views.episode_has_no_camera_has",
    "episode {uuid} has no camera {camera!r:.80}; it has {cameras}",
)
_FIRST_ALLOWED_WHOLE_NUMBER_FROM = Pattern(
    "episodes.views.first_allowed_whole_number_from",
    "first = {first!r:.40}; allowed: a whole number from 0",
)

Result = TypeVar("Result")
PER_PAGE = 50


# --- pages ---------------------------------------------------------------------------------------------------


@require_GET
def replay_list(request: HttpRequest) -> HttpResponseBase:
    """Show all episodes, by default newest first."""
    visibility = visibility_for_request(request)
    listing = Listing(request.GET, listed.columns(visibility), listed.filters(visibility))
    episodes = selectors.episode_list(**listing.chosen, sight=visibility)
    if listing.wants_file:
        return listing.file(request, "episodes", episodes)
    page = listing.page(episodes, PER_PAGE)
    rows = [(episode, selectors.playback_stage(episode=episode)) for episode in page]
    context = {
        "listing": listing,
        "page": page,
        "rows": rows,
        "may_review": role_of(request.user) is not Role.VIEWER,
        "tags": selectors.tag_counts(sight=visibility),
        "passing": any(stage.is_transient for _, stage in rows),
    }
    htmx: Any = request.htmx  # type: ignore[attr-defined]
    template = "episodes/rows.html" if htmx and not htmx.target else "episodes/list.html"
    return render(request, template, context)


@require_GET
def replay(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Show one episode: cameras, robot and curves on one clock."""
    episode = episode_get(uuid=uuid)
    stage = selectors.playback_stage(episode=episode)
    context = {
        "episode": episode,
        "trial": selectors.trial_of(episode=episode),
        "stage": stage,
        "exports": [export_of(episode=episode, wanted=FORMATS[name]) for name in _SHOWN_EXPORTS],
        "may_review": role_of(request.user) is not Role.VIEWER,
        "tags_known": selectors.tag_counts(sight=visibility_for_request(request)),
        "config": replay_config(episode) | player() if stage.name == "ready" else None,
    }
    return render(request, "episodes/replay.html", context)


@require_GET
def playback_stage(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Show how far an episode is on its way to playback, such as "preparing".

    When it is "ready", the response makes the page reload.
    """
    episode = episode_get(uuid=uuid)
    stage = selectors.playback_stage(episode=episode)
    answer = render(request, "episodes/stage.html", {"episode": episode, "stage": stage})
    if stage.name == "ready":
        answer["HX-Refresh"] = "true"
    return answer


async def export(request: HttpRequest, uuid: UUID, format: str = "table") -> HttpResponseBase:
    """Return an exported file of the episode, by default the table of its streams; POST queues its creation."""
    episode, wanted = await _known(uuid), export_format(format)
    if request.method == "POST":
        return await sync_to_async(_export_asked)(request, episode, format)
    await sync_to_async(lambda: visibility_for_request(request).require_episode(episode))()
    path = await sync_to_async(export_file)(uuid, wanted)
    return await file_answer(request, path, wanted.content_type, path.name)


def _export_asked(request: HttpRequest, episode: Episode, format: str) -> HttpResponse:
    require_role(request.user, Role.OPERATOR)
    services.request_export(episode=episode, wanted=export_format(format))
    return export_state(request, episode.uuid, format)


def export_state(request: HttpRequest, uuid: UUID, format: str) -> HttpResponse:
    """Show the state of an exported file, as a fragment of a page that polls."""
    episode = episode_get(uuid=uuid)
    visibility_for_request(request).require_episode(episode)  # its size depends on what is hidden
    context = {"episode": episode, "export": export_of(episode=episode, wanted=export_format(format))}
    return render(request, "episodes/export.html", context)


@require_POST
def preview(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Queue the preview again."""
    require_role(request.user, Role.OPERATOR)
    services.request_preview(episode=episode_get(uuid=uuid))
    return redirect("replay", uuid=uuid)


def player() -> dict[str, Any]:
    """Return the scripts that every page with a player needs."""
    return {"viewer": static("meshcat/main.min.js"), "uplot": static("uplot/uPlot.iife.min.js")}


def replay_config(episode: Episode) -> dict[str, Any]:
    """Return what the modules of the Replay page need to know about an episode: addresses, videos, grid and rate.

    The `start` of a video is the time at which it starts on the page's clock [s].
    """
    address = {
        name: reverse(f"episode-{name}", args=[episode.uuid])
        for name in ("curves", "geometry", "poses", "bench")
    }
    videos = [
        {
            "camera": camera,
            "address": reverse("episode-video", args=[episode.uuid, camera]),
            "start": 0.0,
            "sheet": reverse("episode-sheet", args=[episode.uuid, camera])
            if preview_sheet(episode.uuid, camera).is_file()  # older previews have none
            else "",
        }
        for camera in episode.cameras
    ]
    if episode.kind == IMPORTED and not robots.is_described(episode.robot):
        called = f"calls its robot {episode.robot}" if episode.robot else "names no robot"
        address |= {"geometry": "", "why": f"the dataset {called}: import it with --robot"}
    grid = asdict(Grid.of(episode.frames))
    return {**address, "videos": videos, "grid": grid, "fps": episode.fps, "frames": episode.frames}


# --- files ---------------------------------------------------------------------------------------------------


async def video(request: HttpRequest, uuid: UUID, camera: str) -> HttpResponseBase:
    """Return the video of one camera, also in ranges; redirect to a signed URL if it is in the store."""
    await _known_camera(uuid, camera)
    if address := await asyncio.to_thread(video_address, uuid, camera):
        return HttpResponseRedirect(address)
    return await file_answer(request, await asyncio.to_thread(video_file, uuid, camera), TYPE)


async def sheet(request: HttpRequest, uuid: UUID, camera: str) -> HttpResponseBase:
    """Return the sheet of small images of one camera, in the order of rows."""
    await _known_camera(uuid, camera)
    return await file_answer(request, preview_sheet(uuid, camera), "image/jpeg")


async def thumbnail(request: HttpRequest, uuid: UUID) -> HttpResponseBase:
    """Return an image from the middle of the episode."""
    await _known(uuid)
    return await file_answer(request, preview_folder(uuid) / THUMBNAIL, "image/jpeg")


async def _known(uuid: UUID) -> Episode:
    episode = await Episode.objects.select_related("trial").filter(uuid=uuid).afirst()
    if episode is None:
        raise NotFound(_EPISODE_DOES_NOT_EXIST_THIS(uuid=uuid))
    return episode


async def _known_camera(uuid: UUID, camera: str) -> None:
    """Raise NotFound unless the episode's row names the camera: no other name reaches the disk."""
    cameras = (await _known(uuid)).cameras
    if camera not in cameras:
        raise NotFound(_EPISODE_HAS_NO_CAMERA_HAS(uuid=uuid, camera=camera, cameras=", ".join(cameras)))


@require_GET
def episode_curves(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Return joint curves and events as one message of evaweb.core.binary_frames."""
    episode, visibility = episode_get(uuid=uuid), visibility_for_request(request)
    options = {
        "covered": visibility.hides_episode(episode),
        "unscored": selectors.unscored_for(episode=episode, sight=visibility),
        "milestones": selectors.milestones_of(episode=episode),
    }
    return _binary_response(lambda: curve_message(journal_folder(uuid), **options))


@require_GET
def episode_geometry(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Return the geometry of the robot with the groups recorded, for the 3D scene, as JSON."""
    episode_get(uuid=uuid)
    try:
        manifest = read_json(journal_folder(uuid) / "manifest.json")
    except RecordingError as error:
        raise Conflict(str(error)) from None
    robot = drawn_robot_for(manifest).robot
    groups = [group.name for group in robot.groups]
    return JsonResponse(scene_geometry(robot.name, groups, bench=simulated_bench(manifest)))


@require_GET
def episode_bench(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Return the positions of objects on a simulated bench, at rows where they changed, as JSON."""
    episode_get(uuid=uuid)
    return JsonResponse({"course": _readable(lambda: bench_course(journal_folder(uuid)))})


@require_GET
def episode_poses(request: HttpRequest, uuid: UUID) -> HttpResponse:
    """Return the poses of the robot's parts from row ?first= on, as one message of evaweb.core.binary_frames."""
    episode_get(uuid=uuid)
    first = request.GET.get("first", "0")
    if not (first.isascii() and first.isdecimal()) or len(first) > 9:
        raise EvaError(_FIRST_ALLOWED_WHOLE_NUMBER_FROM(first=first))
    return _binary_response(lambda: pose_message(journal_folder(uuid), int(first)))


def _binary_response(make: Callable[[], bytes]) -> HttpResponse:
    return HttpResponse(_readable(make), content_type="application/octet-stream")


def _readable(make: Callable[[], Result]) -> Result:
    try:
        return make()
    except RecordingError as error:
        raise Conflict(str(error)) from None
