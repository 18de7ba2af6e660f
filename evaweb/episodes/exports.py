"""Files to which an episode is exported: one declaration per format, used by pages, REST and jobs."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import UUID

from django.conf import settings

from evaweb.core.errors import EvaError, NotFound
from evaweb.episodes.folders import data_dir, journal_folder
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.jobs.models import JobStatus
from evaweb.jobs.selectors import job_newest
from evaweb.jobs.workers import waiting_for
from runtime.core.sentences import Pattern
from runtime.interop.mcap_export import PICTURES, McapSummary, Pictures, export_mcap
from runtime.recording.export import export_path, is_exported
from runtime.recording.files import RecordingError, disk_error, read_json
from runtime.recording.labels import FOLDER as LABELS

_CANNOT_BE_HAD = Pattern(
    "episodes.exporting.table_episode_cannot_had",
    "this file of episode {uuid} cannot be had: {error}",
)
_NOT_MADE_YET = Pattern(
    "episodes.exporting.table_episode_not_made_yet",
    "this file of episode {uuid} is not made yet: POST to this address has it made",
)
_NO_FORMAT = Pattern(
    "episodes.exporting.no_format", "an episode is exported as {allowed}, and not as {given!r:.40}"
)
_NO_ROOM = Pattern(
    "episodes.exporting.no_room",
    "there is no room for an MCAP file of episode {uuid}: {free} bytes free, and EVA_RESERVE_GB stays free",
)

MCAP_FOLDER = "mcap"
KEPT_S = 24 * 3600.0  # time for which an MCAP file is kept after it was made


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """Format of an exported file.

    Attributes:
        name: Its name in addresses.
        job: Kind of the job that makes the file.
        suffix: Suffix of the file's name, without the dot.
        content_type: Media type of the file.
        find: Function that returns the existing, current file of an episode, else None; it raises RecordingError.
        args: Arguments of the job besides the episode's uuid.
    """

    name: str
    job: str
    suffix: str
    content_type: str
    find: Callable[[UUID], Path | None]
    args: Mapping[str, str] = field(default_factory=dict)

    def job_key(self, uuid: UUID) -> str:
        """Return the key of the job that makes the file."""
        return ":".join((self.job, *self.args.values(), str(uuid)))

    def job_args(self, uuid: UUID) -> dict[str, Any]:
        """Return the arguments of the job that makes the file."""
        return {"uuid": str(uuid), **self.args}


@dataclass(frozen=True, slots=True)
class Export:
    """State of one exported file of an episode.

    Attributes:
        format: The file's format.
        name: "ready"; "preparing", while its job waits or runs; "failed"; "absent" if it can be requested; "none" if
            there can be no file, because the recording is unfinished, missing, or on another computer.
        sentence: Reason for a failure or for waiting, "" if there is none.
        size: Size of a file that is ready [bytes].
    """

    format: ExportFormat
    name: str
    sentence: str = ""
    size: int = 0


def exported(uuid: UUID) -> Path | None:
    """Return the table of an episode, None if it is not made yet. Raises: RecordingError if the folder is damaged."""
    folder = journal_folder(uuid)
    path = export_path(read_json(folder / "manifest.json"), data_dir())
    return path if is_exported(folder, path) else None


def _mcap_file(uuid: UUID, pictures: str) -> Path:
    return data_dir() / MCAP_FOLDER / f"{uuid}.{pictures}.mcap"


def _current_mcap(uuid: UUID, pictures: str) -> Path | None:
    """Return the MCAP file of an episode, None if there is none or if the recording has been labelled since."""
    path = _mcap_file(uuid, pictures)
    labels = data_dir() / LABELS / f"{uuid}.jsonl"
    try:
        made = path.stat().st_mtime
        return None if labels.exists() and labels.stat().st_mtime >= made else path
    except FileNotFoundError:
        return None


def _mcap(pictures: Pictures) -> ExportFormat:
    return ExportFormat(
        f"mcap-{pictures}",
        "mcap",
        "mcap",
        "application/octet-stream",
        lambda uuid: _current_mcap(uuid, pictures),
        {"pictures": pictures},
    )


TABLE = ExportFormat("table", "export", "parquet", "application/vnd.apache.parquet", exported)
MCAP = {pictures: _mcap(pictures) for pictures in PICTURES}  # by the kind of pictures
FORMATS = {known.name: known for known in (TABLE, *MCAP.values())}


def export_format(name: str) -> ExportFormat:
    """Return the format with that name in addresses. Raises: NotFound with the allowed names."""
    if name not in FORMATS:
        raise NotFound(_NO_FORMAT(allowed=", ".join(FORMATS), given=name))
    return FORMATS[name]


def export_file(uuid: UUID, wanted: ExportFormat) -> Path:
    """Return the existing file of an episode in that format. Raises: NotFound with the way to request it."""
    try:
        path = wanted.find(uuid)
    except RecordingError as error:
        raise NotFound(_CANNOT_BE_HAD(uuid=uuid, error=error)) from None
    if path is None:
        raise NotFound(_NOT_MADE_YET(uuid=uuid))
    return path


def export_of(*, episode: Episode, wanted: ExportFormat) -> Export:
    """Return the state of an episode's file in that format; "none" for an unfinished episode.

    The state follows from the files on disk and from the newest job that makes the file.
    """
    if episode.away_since or episode.status in (EpisodeStatus.RECORDING, EpisodeStatus.MISSING):
        return Export(wanted, "none")
    try:
        path = wanted.find(episode.uuid)
        if path is not None:
            return Export(wanted, "ready", size=path.stat().st_size)
    except RecordingError as error:
        return Export(wanted, "failed", str(error))
    except FileNotFoundError:
        pass  # removed since it was found
    job = job_newest(key=wanted.job_key(episode.uuid))
    if job is None or job.status == JobStatus.DONE:
        return Export(wanted, "absent")
    if job.status == JobStatus.FAILED:
        return Export(wanted, "failed", job.error)
    return Export(wanted, "preparing", job.error or waiting_for(job))


def write_mcap(uuid: UUID, pictures: Pictures, report: Callable[[str], None]) -> tuple[Path, McapSummary]:
    """Write an episode's MCAP file, in place of an earlier one; return it with a summary.

    Raises:
        EvaError: The file would take the room that the lab keeps free for recordings.
        RecordingError: The episode is open or damaged, or the disk refuses the file.
    """
    path, started = _mcap_file(uuid, pictures), time.time()

    def report_if_room(words: str) -> None:
        if (free := shutil.disk_usage(path.parent).free) < settings.EVA_RESERVE_BYTES:
            raise EvaError(_NO_ROOM(uuid=uuid, free=free))
        report(words)

    try:
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        report_if_room("the recording is compared with its seal")
        summary = export_mcap(journal_folder(uuid), path, pictures, report_if_room)
        os.utime(path, (started, started))  # labels of the time since then are not in it
    except OSError as error:
        raise disk_error("writing", path, error) from error
    return path, summary


def remove_old_mcap(now: float | None = None) -> int:
    """Remove MCAP files, and drafts of killed jobs, older than KEPT_S; return their number.

    `now` is the time [Unix s], None for the present.
    """
    limit, removed = (time.time() if now is None else now) - KEPT_S, 0
    for path in (data_dir() / MCAP_FOLDER).glob("*"):
        if path.lstat().st_mtime < limit:
            path.unlink(missing_ok=True)
            removed += 1
    return removed
