"""Synchronisation of the database with the folders on disk; idempotent."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import UUID

from django.db import DataError, IntegrityError

from evaweb.core.errors import EvaError
from evaweb.episodes import services
from evaweb.episodes.dataset_membership import sync_memberships
from evaweb.episodes.folders import data_dir, episodes_dir
from evaweb.episodes.models import Episode
from evaweb.records.journal import Journal, folders
from runtime.recording.files import RecordingError

log = logging.getLogger(__name__)

_SCORES: Journal[Any] = Journal("scores")  # the kinds of lines are registered by higher apps
_OF_ONE_RUN = (
    *(RecordingError, EvaError, DataError, IntegrityError),
    *(OverflowError, RecursionError, ValueError),  # raised for invalid values that no record validates
)


@dataclass(frozen=True, slots=True)
class RestorableRun:
    """Data on disk of one run: whether its folder exists (`recorded`), and the valid `lines` of its scores file.

    `uuid` is the episode's, or for a run without recording the name of its scores file. `report_problem` takes a
    message for an administrator.
    """

    uuid: UUID
    recorded: bool
    lines: Sequence[Any]
    report_problem: Callable[[str], None] = field(default=log.warning, compare=False)


Restorer = Callable[[RestorableRun], int]

_restorers: list[Restorer] = []


def register_restorer(function: Restorer) -> Restorer:
    """Register a function that restores rows from scores files and manifests.

    Apps of higher layers call this when Django starts (`AppConfig.ready`). The registered function is called once per
    run, after earlier restorers; it creates missing rows and returns their number. It raises EvaError if a run cannot
    be restored.
    """
    if function not in _restorers:
        _restorers.append(function)
    return function


Conclusion = Callable[[], Iterable[str]]

_conclusions: list[Conclusion] = []


def register_conclusion(function: Conclusion) -> Conclusion:
    """Register a function that returns messages for administrators after all runs were read."""
    if function not in _conclusions:
        _conclusions.append(function)
    return function


@dataclass(frozen=True, slots=True)
class Report:
    """Result of a reconcile. `problems` concern folders that could not be read, which are left unchanged."""

    episodes: int  # folders read
    made: int  # rows created
    missing: int  # rows without a folder on this disk
    published: int  # rows with an episode in a dataset
    restored: int  # restored trials and scores
    problems: tuple[str, ...]


def reconcile() -> Report:
    """Synchronise the database with every episode and dataset of the data folder."""
    before = set(Episode.objects.values_list("uuid", flat=True))
    uuids, problems = _folders()
    read = []
    for uuid in uuids:
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


def ingest_one(uuid: UUID | str) -> list[str]:
    """Read one newly arrived episode or label into the database; return the problems."""
    uuid, problems = UUID(str(uuid)), list[str]()
    if problem := services.sync_problem(uuid):
        return [problem]
    services.request_exports(uuids=[uuid])
    _give([uuid], {uuid}, problems)
    return problems


def _folders() -> tuple[list[UUID], list[str]]:
    """Return the uuids of the existing episode folders, and messages about other content."""
    root, problems = episodes_dir(), list[str]()
    # Folders with a leading dot are incoming from other computers, or being removed.
    named = (path for path in root.iterdir() if not path.name.startswith(".")) if root.is_dir() else ()
    visible = (path for path in named if path.is_dir())
    return sorted(_uuids_from_names(visible, "", "no episode", problems)), problems


def _uuids_from_names(paths: Iterable[Path], suffix: str, otherwise: str, problems: list[str]) -> set[UUID]:
    """Return the uuids in file names.

    Any other name is added to `problems` as "is `otherwise`", because the file would not be found again.
    """
    uuids = set()
    for path in sorted(paths):
        try:
            uuid = UUID(path.name.removesuffix(suffix))
        except ValueError:
            uuid = None
        if uuid is None or path.name != f"{uuid}{suffix}":
            problems.append(f"{path} is {otherwise}: its name is no uuid in lower case with dashes")
        else:
            uuids.add(uuid)
    return uuids


def _restored(read: Sequence[UUID], problems: list[str]) -> int:
    """Let each restorer, in its order, restore the missing rows of every run; return the number of restored rows.

    `read` are the uuids of the episodes that could be read from disk. Runs that have only a file of scores are restored
    too. Problems are appended to `problems`.
    """
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
    return sum(_made(restore, run, problems) for restore in _restorers for run in runs)


def _made(restore: Restorer, run: RestorableRun, problems: list[str]) -> int:
    try:
        return restore(run)
    except _OF_ONE_RUN as error:
        problems.append(f"run {run.uuid}: {error}")
        return 0
