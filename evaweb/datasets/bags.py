"""Bags in the data folder, and saved mappings of their topics.

Bags are put into the folder `bags` by other programs; nothing here changes them. Mappings are in `bags/mappings`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import robots
from evaweb.core.errors import EvaError, NotFound
from evaweb.core.printed_names import is_name
from evaweb.episodes.folders import data_dir
from runtime.core.durable_files import write_durably
from runtime.core.sentences import Pattern
from runtime.interop.bag_mapping import BagMapping, mapped_robot, parse_mapping
from runtime.interop.bag_reader import bag_size
from runtime.recording.files import RecordingError

_NO_BAG = Pattern("datasets.bags.no_bag", "there is no bag {name!r:.120}; there are: {there}")
_NO_MAPPING = Pattern("datasets.bags.no_mapping", "there is no mapping {name!r:.120}; there are: {there}")
_MAPPING_NAME = Pattern(
    "datasets.bags.mapping_name",
    "mapping = {name!r:.120}; allowed: 1 to 60 letters, digits, - and _, the first one a letter or digit",
)
_MAPPING_LENGTH = Pattern(
    "datasets.bags.mapping_length", "the mapping has {count} characters; allowed: at most {most}"
)
_MAPPING_ROBOT = Pattern("datasets.bags.mapping_robot", "robot = {robot!r:.120}; allowed: {names}")
_MAPPING_REFUSED = Pattern("datasets.bags.mapping_refused", "the mapping was not saved: {why}")

FOLDER = "bags"
_MAPPINGS = "mappings"  # folder below it
_SUFFIXES = (".bag", ".mcap")
_METADATA = "metadata.yaml"  # in the folder of a ROS 2 bag
_DEPTH = 3  # levels below the folder of bags that are searched
_MAPPING_NAME_FORM = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,59}")
_LONGEST_MAPPING = 65536
_NAMED = 8  # names in an error


@dataclass(frozen=True, slots=True)
class BagFile:
    """Bag: its path relative to the folder of bags, its size [bytes], and when it was changed last."""

    name: str
    size: int
    modified: datetime


def bags_dir() -> Path:
    """Return the folder of bags; it may not exist."""
    return data_dir() / FOLDER


def list_bags() -> list[BagFile]:
    """Return all bags by name: MCAP files, .bag files, and folders of ROS 2 bags."""
    root, found = bags_dir(), []
    for path in _walk(root, _DEPTH):
        try:
            modified = datetime.fromtimestamp(path.stat().st_mtime, UTC)
            found.append(BagFile(path.relative_to(root).as_posix(), bag_size(path), modified))
        except FileNotFoundError:
            continue  # removed meanwhile
    return sorted(found, key=lambda bag: bag.name)


def _walk(folder: Path, depth: int) -> Iterator[Path]:
    try:
        entries = list(os.scandir(folder))
    except OSError:
        return  # not there, or not accessible
    for entry in entries:
        path = Path(entry.path)
        if entry.name.startswith(".") or not is_name(entry.name):
            continue
        is_folder = entry.is_dir()
        if (path / _METADATA).is_file() if is_folder else path.suffix in _SUFFIXES:
            yield path
        elif is_folder and depth > 1:
            yield from _walk(path, depth - 1)


def find_bag(name: str) -> Path:
    """Return the path of a bag. Raises: NotFound, which lists the existing ones."""
    names = [bag.name for bag in list_bags()]
    if name not in names:
        raise NotFound(_NO_BAG(name=name, there=_listed(names)))
    return bags_dir() / name


def mapping_names() -> list[str]:
    """Return the names of the saved mappings, sorted."""
    paths = (bags_dir() / _MAPPINGS).glob("*.toml")
    return sorted(path.stem for path in paths if _MAPPING_NAME_FORM.fullmatch(path.stem))


def newest_mapping_at() -> datetime | None:
    """Return when a mapping was saved last; None if there is none."""
    times = [_mapping_path(name).stat().st_mtime for name in mapping_names()]
    return datetime.fromtimestamp(max(times), UTC) if times else None


def read_mapping_text(name: str) -> str:
    """Return a saved mapping as text. Raises: NotFound, which lists the existing ones."""
    names = mapping_names()
    if name not in names:
        raise NotFound(_NO_MAPPING(name=name, there=_listed(names)))
    return _mapping_path(name).read_text(encoding="utf-8")


def save_mapping(name: str, text: str) -> None:
    """Save a mapping under a name; an existing one is replaced.

    Raises: EvaError if the name or the mapping is not allowed; the mapping is checked against its robot.
    """
    if not _MAPPING_NAME_FORM.fullmatch(name):
        raise EvaError(_MAPPING_NAME(name=name))
    check_mapping(text)
    path = _mapping_path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_durably(path, text.encode())


def check_mapping(text: str) -> BagMapping:
    """Return the mapping in a text. Raises: EvaError if it is not allowed, or does not fit its robot."""
    if len(text) > _LONGEST_MAPPING:
        raise EvaError(_MAPPING_LENGTH(count=len(text), most=_LONGEST_MAPPING))
    try:
        mapping = parse_mapping(text, "the mapping")
        require_robot(mapping.robot)
        mapped_robot(mapping)
    except RecordingError as error:
        raise EvaError(_MAPPING_REFUSED(why=str(error))) from error
    return mapping


def require_robot(name: str) -> None:
    """Raise EvaError unless a robot has this name; paths are not allowed."""
    if name not in robots.robot_names():
        raise EvaError(_MAPPING_ROBOT(robot=name, names=", ".join(robots.robot_names())))


def _mapping_path(name: str) -> Path:
    return bags_dir() / _MAPPINGS / f"{name}.toml"


def _listed(names: list[str]) -> str:
    more = f", and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return (", ".join(names[:_NAMED]) or "none") + more
