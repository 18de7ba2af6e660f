"""Availability of a trial's pictures on this machine: without them the trial cannot be judged."""

from __future__ import annotations

from evaweb.episodes.folders import journal_folder, preview_folder
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.selectors import stage_of
from evaweb.errors import Conflict
from evaweb.plans.models import Handout


def seen(episode: Episode | None) -> bool:
    """True if it can be watched now."""
    return (
        episode is not None
        and bool(episode.cameras)
        and episode.status != EpisodeStatus.RECORDING
        and preview_folder(episode.uuid).is_dir()
    )


def coming(episode: Episode | None) -> bool:
    """True if pictures of it may be made yet: its folder is on this disk."""
    return (
        episode is not None
        and bool(episode.cameras and episode.frames)
        and journal_folder(episode.uuid).is_dir()
    )


def require_seen_on_video(*handouts: Handout) -> None:
    """Conflict names the trials of which there are no pictures, each with the reason."""
    blind = [handout for handout in handouts if not seen(handout.trial.episode)]
    if blind:
        told = "; ".join(f"{handout.code}: {_why(handout.trial.episode)}" for handout in blind)
        raise Conflict(f"without pictures nobody can judge {told}")


def _why(episode: Episode | None) -> str:
    if episode is None:
        return "it was not recorded"
    if not episode.cameras:
        return "it was recorded without a camera"
    return stage_of(episode=episode).sentence or "there is no preview of it"
