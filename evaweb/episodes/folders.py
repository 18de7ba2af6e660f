"""Places of an episode's files in the data folder; names come from the database, never from a client."""

from __future__ import annotations

from pathlib import Path
from uuid import UUID

from django.conf import settings

THUMBNAIL = "thumbnail.jpg"


def data_dir() -> Path:
    """The folder of this lab."""
    return Path(settings.DATA_DIR)


def episodes_dir() -> Path:
    """The journals of all episodes."""
    return data_dir() / "episodes"


def journal_folder(uuid: UUID) -> Path:
    """The journal of one episode."""
    return episodes_dir() / str(uuid)


def preview_folder(uuid: UUID) -> Path:
    """Folder of the preview of an episode that a browser plays."""
    return data_dir() / "previews" / str(uuid)


def preview_video(uuid: UUID, camera: str) -> Path:
    """The video of one of the episode's cameras."""
    return preview_folder(uuid) / f"{camera}.mp4"


def preview_sheet(uuid: UUID, camera: str) -> Path:
    """Small pictures of one of the episode's cameras on one sheet."""
    return preview_folder(uuid) / sheet_name(camera)


def sheet_name(camera: str) -> str:
    """File of a camera's sheet in the folder of a preview."""
    return f"{camera}.sheet.jpg"


def datasets_dir() -> Path:
    """All datasets that are published here."""
    return data_dir() / "datasets"


def scores_dir() -> Path:
    """Folder of the raters' scores, a file per episode."""
    return data_dir() / "scores"


def scores_file(uuid: UUID) -> Path:
    """File of the raters' scores of an episode, a line each."""
    return scores_dir() / f"{uuid}.jsonl"
