"""Datasets in the data folder, and their overviews."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

from evaweb.core.environment import HUB_KEY
from evaweb.core.errors import EvaError, NotFound
from evaweb.core.printed_names import is_name
from evaweb.episodes.folders import data_dir
from runtime.core.sentences import Pattern
from runtime.datasets import layout
from runtime.datasets.entries import episode_lines
from runtime.datasets.reader import Dataset, open_dataset
from runtime.recording.files import RecordingError

_NAMES_NO_DATASET_ALLOWED_FOLDER = Pattern(
    "datasets.finding.names_no_dataset_allowed_folder",
    "{name!r:.120} names no dataset; allowed: a folder below the data folder such as datasets/cups, in one "
    "line, without leading dots, and none that is called -",
)
_THERE_NO_DATASET_THERE = Pattern(
    "datasets.finding.there_no_dataset_there",
    "there is no dataset {name!r:.120}; there are: {there}{more}",
)

_LONGEST_PART = 255  # limit of file systems [bytes]
DEPTH = 3  # levels below the data folder that are searched for datasets
# Folders and files of the lab itself, which contain no datasets.
_OWN = frozenset(
    (
        *("episodes", "previews", "arrivals", "archived", "cache", "uploads", "reveals", "exports", "labels"),
        *("mcap", "quality", "quarantine", "reviews", "scores", "sessions"),
        *("stations", "jobs", "broker", "unwritten", "pictures", "logs", "static", "media"),
        *("deployments", "diagnosis", "link", "bags", "farm", "environments", "crates", HUB_KEY),
    )
)


@dataclass(frozen=True, slots=True)
class Overview:
    """Content of a dataset's info.json.

    If it is unreadable or contradictory, `problem` is the reason, and only `name` is set besides.
    """

    name: str  # folder relative to the data folder
    version: str = ""
    robot: str = ""
    fps: float = 0.0
    episodes: int = 0
    frames: int = 0
    tasks: int = 0
    cameras: tuple[str, ...] = ()
    size: int = 0  # size on disk [bytes]
    problem: str = ""

    @property
    def seconds(self) -> float:
        """Total duration [s]."""
        return self.frames / self.fps if self.fps else 0.0

    @property
    def duration_text(self) -> str:
        """Total duration as text."""
        seconds = self.seconds
        if seconds < 120:
            return f"{seconds:.1f} s"
        return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"

    @property
    def short(self) -> str:
        """Name of the dataset without the prefix `datasets/`."""
        return self.name.removeprefix("datasets/")


def dataset_names() -> list[str]:
    """Return the sorted names of all datasets, relative to the data folder."""
    root = data_dir()
    return sorted(path.relative_to(root).as_posix() for path in _walk(root, DEPTH))


def _walk(folder: Path, depth: int) -> Iterator[Path]:
    """Yield the dataset folders below `folder`.

    Hidden folders are skipped, because they are drafts or remains of a crash. Folders with names that no URL can carry
    are skipped too: one of them would break the whole list.
    """
    try:
        below = [Path(entry.path) for entry in os.scandir(folder) if entry.is_dir()]
    except OSError:
        return  # removed meanwhile, or not accessible
    for path in below:
        if not _is_part(path.name) or (folder == data_dir() and path.name in _OWN):
            continue
        if (path / layout.INFO).is_file():
            yield path
        elif depth > 1:
            yield from _walk(path, depth - 1)


def folder_named(name: str) -> Path:
    """Return the folder of an existing or new dataset: below the data folder, never hidden. Raises: EvaError."""
    parts = PurePosixPath(name).parts
    wrong = not parts or len(parts) > DEPTH or not all(map(_is_part, parts))
    long = any(len(part.encode("utf-8", "surrogatepass")) > _LONGEST_PART for part in parts)
    own = parts == ("datasets",) or any(part in _OWN for part in parts[:1])
    if wrong or long or own or PurePosixPath(name).is_absolute():
        raise EvaError(_NAMES_NO_DATASET_ALLOWED_FOLDER(name=name))
    return data_dir().joinpath(*parts)


def _is_part(name: str) -> bool:
    """Return True if a dataset's path may contain this name; "-" ends a dataset's name in URLs."""
    return is_name(name) and name != "-" and not name.startswith(".")


def get_dataset_folder(name: str) -> Path:
    """Return the folder of an existing dataset. Raises: NotFound, which lists the existing ones."""
    folder = folder_named(name)
    if not (folder / layout.INFO).is_file():
        names = dataset_names()
        more = f", and {len(names) - 8} more" if len(names) > 8 else ""
        raise NotFound(_THERE_NO_DATASET_THERE(name=name, there=", ".join(names[:8]) or "none", more=more))
    return folder


def overview(name: str) -> Overview:
    """Return the overview of the dataset of that name."""
    folder = get_dataset_folder(name)
    try:
        info = layout.read_info(folder)
        if problem := _contradiction(folder, _stamp(folder)):
            return Overview(name=name, problem=problem)
        return Overview(
            name=name,
            version=str(info["codebase_version"]),
            robot=str(info.get("robot_type") or ""),
            fps=float(info["fps"]),
            episodes=int(info["total_episodes"]),
            frames=int(info.get("total_frames") or 0),
            tasks=int(info.get("total_tasks") or 0),
            cameras=tuple(camera_keys(info["features"])),
            size=_size(folder, _stamp(folder)),
        )
    except RecordingError as error:
        return Overview(name=name, problem=str(error))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        return Overview(name=name, problem=f"{folder / layout.INFO} is not of the format: {error!r}")


def overviews() -> list[Overview]:
    """Return the overviews of all datasets."""
    return [overview(name) for name in dataset_names()]


def camera_keys(features: dict[str, Any]) -> dict[str, str]:
    """Return a dict from each camera's short name to the feature of its images; videos come first."""
    keys = [*layout.video_keys(features), *layout.image_keys(features)]
    return {key.removeprefix("observation.images.").removeprefix("observation."): key for key in keys}


def open_cached(name: str) -> Dataset:
    """Return the dataset with its list of episodes; re-read only after a change. Raises: RecordingError."""
    folder = get_dataset_folder(name)
    return _opened(folder, _stamp(folder))


def _stamp(folder: Path) -> tuple[int, int]:
    """Return a value that changes with every publication, because info.json is written last."""
    stat = (folder / layout.INFO).stat()
    return stat.st_mtime_ns, stat.st_ino


@lru_cache(16)
def _opened(folder: Path, stamp: tuple[int, int]) -> Dataset:
    return open_dataset(folder)


@lru_cache(256)
def _contradiction(folder: Path, stamp: tuple[int, int]) -> str:
    """Return why the list of episodes contradicts the counts in info.json, "" if it does not."""
    try:
        episode_lines(folder, layout.read_info(folder))
    except RecordingError as error:
        return str(error)
    return ""


@lru_cache(256)
def _size(folder: Path, stamp: tuple[int, int]) -> int:
    total = 0
    for place, _, files in os.walk(folder):
        for file in files:
            try:
                total += os.stat(os.path.join(place, file)).st_size
            except FileNotFoundError:
                continue  # replaced by a publication meanwhile
    return total
