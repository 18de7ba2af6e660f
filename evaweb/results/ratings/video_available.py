"""Availability of a trial's video on this machine, which rating requires."""

from __future__ import annotations

from evaweb.core.errors import Conflict
from evaweb.episodes.folders import journal_folder, preview_folder
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.selectors import playback_stage
from evaweb.plans.models import Handout
from runtime.core.sentences import Pattern

_WITHOUT_PICTURES_NOBODY_CAN_JUDGE = Pattern(
    "results.ratings.video_available.without_pictures_nobody_can_judge",
    "without pictures nobody can judge {told}",
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
        told = "; ".join(f"{handout.code}: {_why(handout.trial.episode)}" for handout in blind)
        raise Conflict(_WITHOUT_PICTURES_NOBODY_CAN_JUDGE(told=told))


def _why(episode: Episode | None) -> str:
    if episode is None:
        return "it was not recorded"
    if not episode.cameras:
        return "it was recorded without a camera"
    return playback_stage(episode=episode).sentence or "there is no preview of it"
