"""Queries on episodes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID

from django.db.models import Count, F, Q, QuerySet

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.core.errors import NotFound
from evaweb.episodes.arriving import whereabouts
from evaweb.episodes.folders import journal_folder, preview_folder
from evaweb.episodes.manifest import CLOSED
from evaweb.episodes.models import Episode, EpisodeStatus, Tag
from evaweb.episodes.services import station_elsewhere
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.selectors import job_newest
from evaweb.jobs.workers import waiting_for
from evaweb.serving.lists import words_of
from runtime.core.sentences import Pattern
from runtime.recording.files import RecordingError, read_json
from runtime.recording.layout import Layout
from runtime.recording.tables import read_table, rows_schema

_EPISODE_DOES_NOT_EXIST_THIS = Pattern(
    "episodes.selectors.episode_does_not_exist_this",
    "episode {uuid} does not exist in this lab",
)

# Related rows on an episode's page; trial, standing and demonstration are defined by higher apps.
_WITH = (
    "station",
    "trial__scene",
    "trial__position",
    "trial__checkpoint",
    "trial__verdict",
    "trial__handout",
    "standing__review",
    "demonstration",
)

# Filters of the list: label and condition.
_ALL = ("all", Q())
QUALITY = {
    "clean": ("clean", Q(standing__clean=True)),
    "flagged": ("flagged", Q(standing__clean=False)),
    "unchecked": ("not checked", Q(standing__checked_at=None)),
    "damaged": ("damaged", ~Q(damage=[])),
}
REVIEW = {
    "unreviewed": ("unreviewed", Q(standing__review=None, frames__gt=0) & ~Q(status=EpisodeStatus.RECORDING)),
    "pass": ("passed", Q(standing__review__verdict="pass")),
    "fail": ("failed", Q(standing__review__verdict="fail")),
}


@dataclass(frozen=True, slots=True)
class PlaybackStage:
    """Stage of an episode's playback: recording, elsewhere, preparing, ready, failed, empty or missing."""

    name: str
    sentence: str = ""

    @property
    def is_transient(self) -> bool:
        """Whether the stage changes without user action, so that a page polls."""
        return self.name in ("recording", "elsewhere", "preparing")


def episode_get(*, uuid: UUID) -> Episode:
    """Return the episode with the related rows of its page. Raises: NotFound."""
    episode = Episode.objects.select_related(*_WITH).filter(uuid=uuid).first()
    if episode is None:
        raise NotFound(_EPISODE_DOES_NOT_EXIST_THIS(uuid=uuid))
    return episode


def episode_list(
    *,
    station: str = "",
    mode: str = "",
    status: str = "",
    quality: str = "",
    review: str = "",
    tag: str = "",
    subset: str = "",
    words: str = "",
    sight: Visibility = FULL_VISIBILITY,
) -> QuerySet[Episode]:
    """Return the episodes, newest first; `words` are searched in task, checkpoint, operator, scene, code and uuid.

    Names of checkpoints, tags, review verdicts and subsets match only if `sight` does not hide them.
    `quality` is a key of QUALITY, `review` one of REVIEW; other values have no effect.
    Raises: EvaError for too many words.
    """
    newest = (F("started_at").desc(nulls_last=True), "-created_at")
    rows = Episode.objects.select_related(*_WITH).prefetch_related("tags").order_by(*newest)
    if station:
        rows = rows.filter(station__name=station)
    if mode:
        rows = rows.filter(mode=mode)
    if status:
        rows = rows.filter(status=status)
    visible = ~Q(checkpoint__in=sight.names) & ~Q(trial__checkpoint__in=sight.checkpoints)
    if tag:
        rows = rows.filter(_by_someone(visible, "tags__by", sight), tags__words=tag)
    if subset:
        rows = rows.filter(Q() if sight.hides_nothing else visible, subsets__name=subset)
    if review in ("pass", "fail"):
        rows = rows.filter(_by_someone(visible, "standing__review__reviewer", sight))
    rows = rows.filter(QUALITY.get(quality, _ALL)[1], REVIEW.get(review, _ALL)[1])
    for word in words_of(words):
        rows = rows.filter(
            Q(task__icontains=word)
            | (
                Q(checkpoint__icontains=word) & visible
                if not sight.hides_nothing
                else Q(checkpoint__icontains=word)
            )
            | Q(trial__handout__code__iexact=word)
            | Q(operator__icontains=word)
            | Q(trial__scene__title__icontains=word)
            | Q(uuid__icontains=word)
        )
    return rows


def tag_counts(*, sight: Visibility = FULL_VISIBILITY) -> dict[str, int]:
    """Return the lab's tags in alphabetical order with the number of episodes of each."""
    visible = ~Q(episode__checkpoint__in=sight.names) & ~Q(episode__trial__checkpoint__in=sight.checkpoints)
    rows = Tag.objects.filter(_by_someone(visible, "by", sight)).order_by("words").values_list("words")
    return {text: n for text, n in rows.annotate(n=Count("pk")) if not sight.named_in(text)}


def _by_someone(visible: Q, author: str, visibility: Visibility) -> Q:
    """Return the condition for opinions of people (reviews and tags) that this user may see.

    These are the opinions on the episodes that match `visible`, and the user's own opinions. `author` is the query path
    to the author of an opinion.
    """
    return Q() if visibility.hides_nothing else visible | Q(**{author: visibility.user})


def playback_stage(*, episode: Episode) -> PlaybackStage:
    """Return the playback stage, from row, disk and the newest preview job."""
    if preview_folder(episode.uuid).is_dir() and episode.status != EpisodeStatus.RECORDING:
        return PlaybackStage("ready")
    if episode.status == EpisodeStatus.RECORDING:
        return PlaybackStage(
            "recording",
            episode.reason
            or f"{episode.station} is still writing it. If the station was cut off meanwhile, it completes the "
            "episode when it starts again.",
        )
    if episode.status == EpisodeStatus.MISSING or not journal_folder(episode.uuid).is_dir():
        if episode.away_since is not None:
            return PlaybackStage("elsewhere", whereabouts(episode))
        return PlaybackStage(
            "missing",
            "Its folder is not on this machine: it was moved, or recorded elsewhere. Bring it back, then run "
            "manage.py reconcile.",
        )
    if not episode.frames:
        return PlaybackStage("empty", f"Nothing was recorded: {episode.reason or 'it has no rows'}.")
    return _preparing(job_newest(key=f"preview:{episode.uuid}"))


def why_unrecorded(*, episode: Episode | None) -> str:
    """Return the reason why no row of the run was recorded; "" if at least one row was.

    Without a recorded row, nothing proves that the run moved anything.
    """
    if episode is None:
        return "nothing of its run was recorded"
    if episode.frames:
        return ""
    if episode.status in CLOSED:
        return f"episode {episode.uuid} of its run has no rows"
    folder, later = journal_folder(episode.uuid), "look again once it is closed"
    if not folder.is_dir() and station_elsewhere(episode.station):
        where = f"the computer of {episode.station}"
        return f"{where} has not sent yet what is in episode {episode.uuid} of its run: {later}"
    if not folder.is_dir():
        return f"episode {episode.uuid} of its run has no folder: nothing of it is on this disk"
    return "" if _rows_written(folder) else f"no row of episode {episode.uuid} is on the disk yet: {later}"


def _rows_written(folder: Path) -> int:
    """Return the number of rows on disk of an open episode; 0 if its files cannot be read."""
    try:
        layout = Layout.from_manifest(read_json(folder / "manifest.json"))
        return int(read_table(folder / "rows.arrow", rows_schema(layout)).table.num_rows)
    except RecordingError:
        return 0


def _preparing(job: Job | None) -> PlaybackStage:
    if job is None or job.status == JobStatus.DONE:
        return PlaybackStage("failed", "There is no preview yet, and none is being made.")
    if job.status == JobStatus.FAILED:
        return PlaybackStage("failed", job.error)
    if job.status == JobStatus.RUNNING:
        return PlaybackStage(
            "preparing", f"The videos are being prepared{': ' if job.progress else ''}{job.progress}."
        )
    if job.error:
        return PlaybackStage("preparing", f"Another attempt follows in a moment: {job.error}")
    return PlaybackStage("preparing", waiting_for(job) or "The videos wait for the worker to prepare them.")


def unscored_for(*, episode: Episode, sight: Visibility) -> bool:
    """Return True if the user is to score the trial of this recording before learning its outcome."""
    return sight.hides_episode(episode) and not getattr(trial_of(episode=episode), "verdict_id", None)


def milestones_of(*, episode: Episode) -> list[tuple[float, str]]:
    """Return when each milestone was reached [s after the start of the run], by the current score; [] without one."""
    verdict = getattr(trial_of(episode=episode), "verdict", None)
    outcomes = verdict.outcomes.exclude(at_s=None) if verdict is not None else ()
    return [(outcome.at_s, outcome.text) for outcome in outcomes if outcome.reached]


def trial_of(*, episode: Episode) -> Any:
    """Return the trial of the recording, None if there is none."""
    return getattr(episode, "trial", None)
