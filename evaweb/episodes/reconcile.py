"""Disk to database: makes the rows say what the folders say. Running it again changes nothing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import UUID

from evaweb.episodes import services
from evaweb.episodes.folders import data_dir, datasets_dir, episodes_dir, scores_dir
from evaweb.episodes.models import Episode
from evaweb.episodes.publishing import score_lines
from evaweb.errors import EvaError
from runtime.datasets.catalog import Catalog
from runtime.datasets.layout import EVA_EPISODES
from runtime.recording.files import RecordingError

log = logging.getLogger(__name__)

Lines = Sequence[Mapping[str, Any]]
Restorer = Callable[[UUID, Lines], int]

_restorers: list[Restorer] = []


def restores_scores(function: Restorer) -> Restorer:
    """Declare who understands the lines of DATA/scores/<uuid>.jsonl: an app above this one, from its `ready`.

    It is given all whole lines of one file, makes the rows that are not there, and returns how many.
    """
    if function not in _restorers:
        _restorers.append(function)
    return function


@dataclass(frozen=True, slots=True)
class Report:
    """What was found. `problems` are sentences about folders that could not be read; nothing is done to those."""

    episodes: int  # folders that were read
    made: int  # rows that were not there
    missing: int  # rows whose folder is not on this disk
    published: int  # rows that are in a dataset
    restored: int  # verdicts that were not in the database, brought back from the files of scores
    problems: tuple[str, ...]


def reconcile() -> Report:
    """Read every episode and every dataset of the data folder into the database."""
    before = set(Episode.objects.values_list("uuid", flat=True))
    found, problems = _folders()
    read = []
    for uuid in found:
        problem = services.problem_of(uuid)
        if problem:
            problems.append(problem)
        else:
            read.append(uuid)
    missing = services.missing_marked()
    problems += _datasets()
    restored = _scores(problems)
    for problem in problems:
        log.warning("%s", problem)
    return Report(
        episodes=len(read),
        made=len(set(read) - before),
        missing=missing,
        published=Episode.objects.exclude(dataset_index=None).count(),
        restored=restored,
        problems=tuple(problems),
    )


def _folders() -> tuple[list[UUID], list[str]]:
    """The episodes that there are, and what else lies there."""
    root = episodes_dir()
    folders = sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    found, problems = [], []
    for folder in folders:
        try:
            uuid = UUID(folder.name)
        except ValueError:
            uuid = None
        if uuid is None or str(uuid) != folder.name:
            problems.append(f"{folder} is no episode: its name is no uuid")
        else:
            found.append(uuid)
    return found, problems


def _datasets() -> list[str]:
    root = datasets_dir()
    folders = sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    # Where an episode is in two, the one that knows its success counts.
    folders.sort(key=lambda folder: not folder.name.endswith("-unscored"))
    problems = []
    for folder in folders:
        try:
            _places(folder)
        except RecordingError as error:
            problems.append(str(error))
    return problems


def _places(folder: Path) -> None:
    lines = Catalog.read(folder).eva
    if not lines:
        return
    published_at = datetime.fromtimestamp((folder / EVA_EPISODES).stat().st_mtime, UTC)
    name = str(folder.relative_to(data_dir()))
    for line in lines:
        place = {"dataset": name, "dataset_index": line["episode_index"]}
        row = Episode.objects.filter(uuid=line["uuid"])
        if not row.filter(**place).exists():
            row.update(**place, published_at=published_at)


def _scores(problems: list[str]) -> int:
    """Give every file of scores to who understands it; what cannot be restored is added to `problems`."""
    restored = 0
    for file in sorted(scores_dir().glob("*.jsonl")):
        try:
            lines = list(score_lines(file))
            restored += sum(restore(UUID(file.stem), lines) for restore in _restorers)
        except (RecordingError, EvaError, ValueError) as error:
            problems.append(f"{file}: {error}")
    return restored
