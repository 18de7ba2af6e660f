"""Parquet table with the three action streams of an episode: path and state."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from evaweb.core.errors import NotFound
from evaweb.episodes.folders import data_dir, journal_folder
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.jobs.models import JobStatus
from evaweb.jobs.selectors import job_newest
from evaweb.jobs.workers import waiting_for
from runtime.core.sentences import Pattern
from runtime.recording.export import export_path, is_exported
from runtime.recording.files import RecordingError, read_json

_TABLE_EPISODE_CANNOT_HAD = Pattern(
    "episodes.exporting.table_episode_cannot_had",
    "the table of episode {uuid} cannot be had: {error}",
)
_TABLE_EPISODE_NOT_MADE_YET = Pattern(
    "episodes.exporting.table_episode_not_made_yet",
    "the table of episode {uuid} is not made yet: POST to this address has it made",
)

CONTENT_TYPE = "application/vnd.apache.parquet"


@dataclass(frozen=True, slots=True)
class Table:
    """State of an episode's table.

    Attributes:
        name: "ready"; "preparing", while its job waits or runs; "failed"; "absent" if it can be requested; "none" if
            there can be no table, because the recording is unfinished, missing, or on another computer.
        sentence: Reason for a failure or for waiting, "" if there is none.
        size: Size of a table that is ready [bytes].
    """

    name: str
    sentence: str = ""
    size: int = 0


def job_key(uuid: UUID) -> str:
    """Return the key of the job that makes the table."""
    return f"export:{uuid}"


def exported(uuid: UUID) -> Path | None:
    """Return the table of an episode, None if it is not made yet. Raises: RecordingError if the folder is damaged."""
    folder = journal_folder(uuid)
    path = export_path(read_json(folder / "manifest.json"), data_dir())
    return path if is_exported(folder, path) else None


def table_file(uuid: UUID) -> Path:
    """Return the existing table. Raises: NotFound with the way to request it."""
    try:
        path = exported(uuid)
    except RecordingError as error:
        raise NotFound(_TABLE_EPISODE_CANNOT_HAD(uuid=uuid, error=error)) from None
    if path is None:
        raise NotFound(_TABLE_EPISODE_NOT_MADE_YET(uuid=uuid))
    return path


def table_of(*, episode: Episode) -> Table:
    """Return the state of an episode's export table; "none" for an unfinished episode.

    The state follows from the files on disk and from the newest job that makes the table.
    """
    if episode.away_since or episode.status in (EpisodeStatus.RECORDING, EpisodeStatus.MISSING):
        return Table("none")
    try:
        path = exported(episode.uuid)
    except RecordingError as error:
        return Table("failed", str(error))
    if path is not None:
        return Table("ready", size=path.stat().st_size)
    job = job_newest(key=job_key(episode.uuid))
    if job is None or job.status == JobStatus.DONE:
        return Table("absent")
    if job.status == JobStatus.FAILED:
        return Table("failed", job.error)
    return Table("preparing", job.error or waiting_for(job))
