"""Disk to database: makes the rows say what the folders say. Running it again changes nothing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import UUID

from django.db import DataError, IntegrityError

from evaweb.episodes import services
from evaweb.episodes.dataset_membership import sync_memberships
from evaweb.episodes.folders import data_dir, episodes_dir
from evaweb.episodes.models import Episode
from evaweb.errors import EvaError
from evaweb.journal import Journal, folders
from runtime.recording.files import RecordingError

log = logging.getLogger(__name__)

_SCORES: Journal[Any] = Journal("scores")  # of all kinds: those of the apps above
_OF_ONE_RUN = (
    *(RecordingError, EvaError, DataError, IntegrityError),
    *(OverflowError, RecursionError, ValueError),  # of what no record has declared
)


@dataclass(frozen=True, slots=True)
class RestorableRun:
    """Data on the disk of one run: its folder, if `recorded`, and the `lines` of its scores file that say something.

    `uuid` is the episode's; of a run that was not recorded, whatever the writers of its lines named it by. `say` takes
    a sentence about what a person should look at.
    """

    uuid: UUID
    recorded: bool
    lines: Sequence[Any]
    report_problem: Callable[[str], None] = field(default=log.warning, compare=False)


Restorer = Callable[[RestorableRun], int]

_restorers: list[Restorer] = []


def register_restorer(function: Restorer) -> Restorer:
    """Declare the reader of scores and the `trial` of a manifest: an app above this one, from its `ready`.

    It is given every run once, after the readers before it were, makes the rows that are not there, and returns how
    many. EvaError says what could not be restored.
    """
    if function not in _restorers:
        _restorers.append(function)
    return function


Conclusion = Callable[[], Iterable[str]]

_conclusions: list[Conclusion] = []


def register_conclusion(function: Conclusion) -> Conclusion:
    """Declare what says, once all runs were read, what a person should look at: an app above this one."""
    if function not in _conclusions:
        _conclusions.append(function)
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
        problem = services.sync_problem(uuid)
        if problem:
            problems.append(problem)
        else:
            read.append(uuid)
    services.request_exports(uuids=read)
    missing = services.mark_missing()
    problems += sync_memberships()
    restored = _restored(read, problems)
    problems += [sentence for conclude in _conclusions for sentence in conclude()]
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


def taken_in(uuid: UUID | str) -> list[str]:
    """Read one episode that has come to the disk, or what was said of it, into the database; what is wrong with it."""
    uuid, problems = UUID(str(uuid)), list[str]()
    if problem := services.sync_problem(uuid):
        return [problem]
    services.request_exports(uuids=[uuid])
    _give([uuid], {uuid}, problems)
    return problems


def _folders() -> tuple[list[UUID], list[str]]:
    """The episodes that there are, and what else lies there."""
    root, problems = episodes_dir(), list[str]()
    # Folders with a dot are of what is on its way from other computers, or on its way out.
    named = (path for path in root.iterdir() if not path.name.startswith(".")) if root.is_dir() else ()
    there = (path for path in named if path.is_dir())
    return sorted(_uuids_from_names(there, "", "no episode", problems)), problems


def _uuids_from_names(paths: Iterable[Path], suffix: str, otherwise: str, problems: list[str]) -> set[UUID]:
    """What they are named by: a uuid as this program writes it, or it would not be found again."""
    found = set()
    for path in sorted(paths):
        try:
            uuid = UUID(path.name.removesuffix(suffix))
        except ValueError:
            uuid = None
        if uuid is None or path.name != f"{uuid}{suffix}":
            problems.append(f"{path} is {otherwise}: its name is no uuid in lower case with dashes")
        else:
            found.add(uuid)
    return found


def _restored(read: Sequence[UUID], problems: list[str]) -> int:
    """Give every run to its readers, one reader after the other; what cannot be restored is added to `problems`."""
    files = {
        folder: _uuids_from_names(
            (data_dir() / folder).glob("*.jsonl"), ".jsonl", f"no file of {folder}", problems
        )
        for folder in folders()
    }
    recorded, scored = set(read), files.get(_SCORES.folder, set())
    in_order = Episode.objects.order_by("started_at").values_list("uuid", flat=True)
    uuids = (*(uuid for uuid in in_order if uuid in recorded), *sorted(scored - recorded))
    return _give(uuids, recorded, problems)


def _give(uuids: Iterable[UUID], recorded: Collection[UUID], problems: list[str]) -> int:
    runs = []
    for uuid in uuids:
        try:
            lines = _SCORES.read(uuid, problems.append)
            runs.append(RestorableRun(uuid, uuid in recorded, lines, problems.append))
        except RecordingError as error:
            problems.append(f"run {uuid}: {error}")
    return sum(_made(restore, kept, problems) for restore in _restorers for kept in runs)


def _made(restore: Restorer, kept: RestorableRun, problems: list[str]) -> int:
    try:
        return restore(kept)
    except _OF_ONE_RUN as error:
        problems.append(f"run {kept.uuid}: {error}")
        return 0
