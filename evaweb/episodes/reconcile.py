"""Disk to database: makes the rows say what the folders say. Running it again changes nothing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

from django.db import DataError, IntegrityError

from evaweb.episodes import services
from evaweb.episodes.dataset_membership import places_read
from evaweb.episodes.folders import episodes_dir, scores_dir, scores_file
from evaweb.episodes.models import Episode
from evaweb.errors import EvaError
from evaweb.journal import read_lines
from runtime.recording.files import RecordingError

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Kept:
    """Data on the disk of one run: its folder, if `recorded`, and the whole `lines` of its scores file.

    `uuid` is the episode's; of a run that was not recorded, whatever the writers of its lines named it by. `say` takes
    a sentence about what a person should look at.
    """

    uuid: UUID
    recorded: bool
    lines: Sequence[Mapping[str, Any]]
    say: Callable[[str], None] = field(default=log.warning, compare=False)


Restorer = Callable[[Kept], int]

_restorers: list[Restorer] = []


def restores(function: Restorer) -> Restorer:
    """Declare the reader of scores and the `trial` of a manifest: an app above this one, from its `ready`.

    It is given every run once, makes the rows that are not there, and returns how many. EvaError says what
    could not be restored.
    """
    if function not in _restorers:
        _restorers.append(function)
    return function


@dataclass(frozen=True, slots=True)
class Report:
    """Findings of a reconcile. `problems` are of folders that could not be read; nothing is done to those."""

    episodes: int  # folders that were read
    made: int  # rows that were not there
    missing: int  # rows whose folder is not on this disk
    published: int  # rows that are in a dataset
    restored: int  # trials and verdicts that were not in the database
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
    services.exports_asked(uuids=read)
    missing = services.missing_marked()
    problems += places_read()
    restored = _restored(read, problems)
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


def _restored(read: Sequence[UUID], problems: list[str]) -> int:
    """Give every run to its readers; what cannot be restored is added to `problems`."""
    recorded = set(read)
    in_order = Episode.objects.order_by("started_at").values_list("uuid", flat=True)
    scored = _scored(problems)
    restored = 0
    for uuid in (*(uuid for uuid in in_order if uuid in recorded), *sorted(scored - recorded)):
        try:
            lines = _lines(uuid, problems) if uuid in scored else ()
            kept = Kept(uuid, uuid in recorded, lines, problems.append)
            restored += sum(restore(kept) for restore in _restorers)
        except (RecordingError, EvaError, DataError, IntegrityError) as error:
            problems.append(f"run {uuid}: {error}")
    return restored


def _scored(problems: list[str]) -> set[UUID]:
    """The runs that have a file of scores."""
    found = set()
    for file in sorted(scores_dir().glob("*.jsonl")):
        try:
            found.add(UUID(file.stem))
        except ValueError:
            problems.append(f"{file} is no file of scores: its name is no uuid")
    return found


def _lines(uuid: UUID, problems: list[str]) -> Sequence[Mapping[str, Any]]:
    found = read_lines(scores_file(uuid))
    problems += [f"{scores_file(uuid)}: line {number} is not whole and was left out" for number in found.torn]
    return found.lines
