"""Footage of a trial for raters: whether its video is on this machine, and anonymous images for a judge."""

from __future__ import annotations

from evaweb.core.errors import Conflict
from evaweb.episodes.folders import journal_folder, preview_folder
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.preview import jpeg_of
from evaweb.episodes.selectors import playback_stage
from evaweb.episodes.videos import video_file
from evaweb.plans.models import Handout
from evaweb.results.judges.base import StillImage
from runtime.core.sentences import Pattern
from runtime.datasets.video_frames import VideoFrames

_WITHOUT_PICTURES_NOBODY_CAN_JUDGE = Pattern(
    "results.ratings.video_available.without_pictures_nobody_can_judge",
    "pictures are needed to judge {told}",
)


def is_watchable(episode: Episode | None) -> bool:
    """Return True if the episode can be watched now."""
    return (
        episode is not None
        and bool(episode.cameras)
        and episode.status != EpisodeStatus.RECORDING
        and preview_folder(episode.uuid).is_dir()
    )


def may_become_watchable(episode: Episode | None) -> bool:
    """Return True if the episode may become watchable: its folder is on this disk, or is being transferred."""
    return (
        episode is not None
        and bool(episode.cameras and episode.frames)
        and (episode.away_since is not None or journal_folder(episode.uuid).is_dir())
    )


def require_video(*handouts: Handout) -> None:
    """Raise Conflict, with the reason for each trial, if trials have no video."""
    blind = [handout for handout in handouts if not is_watchable(handout.trial.episode)]
    if blind:
        reasons = "; ".join(f"{handout.code}: {_why(handout.trial.episode)}" for handout in blind)
        raise Conflict(_WITHOUT_PICTURES_NOBODY_CAN_JUDGE(told=reasons))


def _why(episode: Episode | None) -> str:
    if episode is None:
        return "it was not recorded"
    if not episode.cameras:
        return "it was recorded without a camera"
    return playback_stage(episode=episode).sentence or "there is no preview of it"


CAMERAS = 4  # first cameras of the recording
OF_EACH = 8  # images per camera, evenly spaced, including first and last
WIDTH = 512  # [pixels] largest width


def trial_stills(episode: Episode) -> tuple[StillImage, ...]:
    """Return the images by camera and time, for the cameras with a video.

    Raises:
        RecordingError: If a video is damaged.
    """
    stills = []
    for number, camera in enumerate(episode.cameras[:CAMERAS], 1):
        video = video_file(episode.uuid, camera)
        if not video.exists():  # the camera failed before its first image
            continue
        with VideoFrames(video) as pictures:
            times = pictures.times
            for index in sample(len(pictures)):
                pixels = pictures[index]
                jpeg = jpeg_of(pixels, min(WIDTH, pixels.shape[1]))
                stills.append(StillImage(f"camera {number}", round(times[index] - times[0], 3), jpeg))
    return tuple(stills)


def sample(n: int, most: int = OF_EACH) -> list[int]:
    """Return at most `most` of the indices 0 to n - 1, evenly spaced, including both ends."""
    if n <= most:
        return list(range(n))
    return [round(k * (n - 1) / (most - 1)) for k in range(most)]
