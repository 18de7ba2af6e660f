"""Everything that can be replayed, by name: a recording by its uuid, an episode of a dataset as NAME:INDEX."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode
from uuid import UUID

from django.urls import reverse

import robots
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import Conflict, NotFound
from evaweb.datasets.dataset_orders import full_name
from evaweb.datasets.playback import PlayedEpisode, load_played_episode
from evaweb.episodes.models import Episode
from evaweb.episodes.selectors import episode_get, playback_stage
from evaweb.episodes.views import replay_config
from runtime.core.sentences import Pattern
from runtime.recording.files import RecordingError

_EPISODE_CANNOT_PLAYED_YET = Pattern(
    "datasets.sources.episode_cannot_played_yet",
    "episode {uuid} cannot be played yet. {sentence}",
)
_NO_EPISODE_ALLOWED_UUID_RECORDING = Pattern(
    "datasets.sources.no_episode_allowed_uuid_recording",
    "{name!r:.120} is no episode; allowed: the uuid of a recording, or DATASET:INDEX",
)


@dataclass(frozen=True, slots=True)
class ReplayEntry:
    """Episode on a page: its `name` in URLs, and the `config` of the page's modules."""

    name: str
    title: str
    detail: str
    address: str
    cameras: tuple[str, ...]
    config: dict[str, Any]


def resolve_entry(request: Any, name: str) -> ReplayEntry:
    """Return the episode of that name. Raises: NotFound; Conflict if it cannot be played."""
    try:
        uuid = UUID(name)
    except ValueError:
        return _of_dataset(name)
    return _recording(request, episode_get(uuid=uuid))


def _recording(request: Any, episode: Episode) -> ReplayEntry:
    stage = playback_stage(episode=episode)
    if stage.name != "ready":
        raise Conflict(_EPISODE_CANNOT_PLAYED_YET(uuid=episode.uuid, sentence=stage.sentence))
    made_by = visibility_for_request(request).policy_of(episode)
    started = f"{episode.started_at:%Y-%m-%d %H:%M:%S}" if episode.started_at else "time unknown"
    return ReplayEntry(
        name=str(episode.uuid),
        title=episode.task or "Episode without a task",
        detail=" · ".join(filter(None, (started, str(episode.station), made_by))),
        address=reverse("replay", args=[episode.uuid]),
        cameras=tuple(episode.cameras),
        config=replay_config(episode),
    )


def _of_dataset(name: str) -> ReplayEntry:
    dataset, colon, index = name.rpartition(":")
    if not (colon and index.isascii() and index.isdecimal() and len(index) < 10):
        raise NotFound(_NO_EPISODE_ALLOWED_UUID_RECORDING(name=name))
    episode = open_dataset_episode(full_name(dataset), int(index))
    return ReplayEntry(
        name=f"{episode.name}:{episode.index}",
        title=episode.task or "Episode without a task",
        detail=f"{episode.name.removeprefix('datasets/')}, episode {episode.index}",
        address=dataset_address("dataset-replay", episode),
        cameras=tuple(episode.cameras),
        config=dataset_config(episode),
    )


def open_dataset_episode(name: str, index: int, robot: str = "") -> PlayedEpisode:
    """Return episode `index` of a dataset, interpreted for `robot` if given.

    Raises: NotFound; Conflict if the dataset is unreadable.
    """
    try:
        return load_played_episode(name, index, robot)
    except RecordingError as error:
        raise Conflict(str(error)) from None


def dataset_address(route: str, episode: PlayedEpisode, *more: Any) -> str:
    """Return a URL of an episode of a dataset, with the chosen robot if there is one."""
    path = reverse(route, args=[episode.name, episode.index, *more])
    return f"{path}?{urlencode({'robot': episode.robot})}" if episode.robot_is_assumed else path


def dataset_config(episode: PlayedEpisode) -> dict[str, Any]:
    """Return the settings of the page's modules, in the form of evaweb.episodes.views.replay_config."""
    is_described = robots.is_described(episode.robot)
    videos = []
    for camera in episode.cameras:
        span = episode.video(camera)
        route = "dataset-picture" if span is None else "dataset-video"
        videos.append(
            {
                "camera": camera,
                "address": dataset_address(route, episode, camera),
                "start": 0.0 if span is None else span.start or 0.0,
                "pictures": span is None,
            }
        )
    return {
        "curves": dataset_address("dataset-curves", episode),
        "geometry": dataset_address("dataset-geometry", episode) if is_described else "",
        "why": ""
        if is_described
        else f"the dataset calls its robot {episode.robot or 'nothing'}: choose the one to be drawn under Details",
        "poses": dataset_address("dataset-poses", episode),
        "segments": dataset_address("dataset-segments", episode),
        "videos": videos,
        "fps": episode.fps,
        "frames": episode.frames,
    }
