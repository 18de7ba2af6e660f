"""Index of the camera files that a lab has moved to its store, DATA/archived/<uuid>.json.

The recording stays as it was sealed; only the bytes of these files are elsewhere. This module reads the index, so that
a file that is in the store is never taken for a lost one. The lab moves the files (evaweb.episodes.archive).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TypeGuard

from runtime.core.durable_files import sync_folder
from runtime.core.errors import RecordingError
from runtime.recording.damage_marks import data_of
from runtime.recording.files import disk_error, read_json, to_json, write_atomic

FOLDER = "archived"
CAMERA_FILES = ".mp4"
_NAME, _DIGEST = re.compile(r"[^/\x00]+\.mp4"), re.compile("[0-9a-f]{64}")


def index_file(data: Path, uuid: str) -> Path:
    """Return the path of a recording's index."""
    return data / FOLDER / f"{uuid}.json"


def stored_files(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of DATA/episodes/<uuid> that is in the lab's store, by name; {} if none is.

    Raises RecordingError if the index cannot be read.
    """
    data = data_of(folder)
    path = index_file(data, folder.absolute().name) if data else None
    if path is None or not _is_there(path):
        return {}
    files = read_json(path).get("files")
    if not _are_entries(files):
        raise RecordingError(
            f"{path} does not say which files of the recording are in the store: bring it back from a backup"
        )
    return files


def write_index(data: Path, uuid: str, files: Mapping[str, str]) -> None:
    """Write a recording's index so that it survives a power cut.

    Raises RecordingError, also for files that `stored_files` would not accept.
    """
    path = index_file(data, uuid)
    if not _are_entries(dict(files)):
        raise RecordingError(
            f"{path} cannot name {', '.join(map(repr, files)) or 'no files'}: allowed are names of videos in the "
            f"recording's own folder, *{CAMERA_FILES}, with their SHA-256"
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        sync_folder(data)
    except OSError as error:
        raise disk_error("writing", path, error) from error
    write_atomic(path, to_json({"files": dict(files)}, "the index of stored files", indent=1))


def require_not_stored(path: Path) -> None:
    """Raise RecordingError with the way to bring it back if the file, which is absent, is in the lab's store."""
    folder = path.absolute().parent
    if path.name in stored_files(folder):
        raise RecordingError(
            f"{path} is in the lab's store (EVA_STORE): manage.py archive --back {folder.name} brings it back"
        )


def _is_there(path: Path) -> bool:
    """Return True unless the file is absent; a file that may not be looked at is there, and cannot be read."""
    try:
        path.lstat()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise disk_error("looking at", path, error) from error
    return True


def _are_entries(files: object) -> TypeGuard[dict[str, str]]:
    return isinstance(files, dict) and bool(files) and all(map(_is_entry, files.items()))


def _is_entry(entry: tuple[object, object]) -> bool:
    name, digest = entry
    return (
        isinstance(name, str)
        and isinstance(digest, str)
        and bool(_NAME.fullmatch(name) and _DIGEST.fullmatch(digest))
    )
