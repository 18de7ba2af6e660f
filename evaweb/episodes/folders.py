"""Paths of an episode's files in the data folder; names come from the database, never from a client."""

from __future__ import annotations

from pathlib import Path
from uuid import UUID

from django.conf import settings

from runtime.recording.archive_index import FOLDER

THUMBNAIL = "thumbnail.jpg"


def data_dir() -> Path:
    """Return the data folder of this lab."""
    return Path(settings.DATA_DIR)


def episodes_dir() -> Path:
    """Return the folder of all recordings."""
    return data_dir() / "episodes"


def journal_folder(uuid: UUID) -> Path:
    """Return the folder of one recording."""
    return episodes_dir() / str(uuid)


def archive_folder() -> Path:
    """Return the folder of the indexes of recordings whose camera files are in the lab's store."""
    return data_dir() / FOLDER


def preview_folder(uuid: UUID) -> Path:
    """Return the folder of an episode's preview."""
    return data_dir() / "previews" / str(uuid)


def preview_video(uuid: UUID, camera: str) -> Path:
    """Return the preview video of one camera."""
    return preview_folder(uuid) / f"{camera}.mp4"


def preview_sheet(uuid: UUID, camera: str) -> Path:
    """Return the sheet of small images of one camera."""
    return preview_folder(uuid) / sheet_name(camera)


def sheet_name(camera: str) -> str:
    """Return the file name of a camera's sheet."""
    return f"{camera}.sheet.jpg"


def datasets_dir() -> Path:
    """Return the folder of published datasets."""
    return data_dir() / "datasets"


def scores_dir() -> Path:
    """Return the folder of score files, one per episode."""
    return data_dir() / "scores"


def scores_file(uuid: UUID) -> Path:
    """Return the file of an episode's scores, one line each."""
    return scores_dir() / f"{uuid}.jsonl"
