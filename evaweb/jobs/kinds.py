"""Registry of job kinds; apps declare theirs in a module `job_kinds`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from evaweb.accounts.roles import Role
from evaweb.core.errors import EvaError

Args = Mapping[str, Any]
ORDERED_BY = (
    "ordered_by"  # argument of jobs that use something of the person who ordered them: their primary key
)


class Queue(StrEnum):
    """Resource that a machine must have for a job, besides the lab's data folder."""

    CPU = "cpu"  # CPU time, and a disk that is fast enough for recordings
    GPU = "gpu"  # an accelerator, or access to a server with one
    STATION = "station"  # the deployment files of this lab's stations, and access to their policy servers
    COPIES = "copies"  # the same, and CPU time for trials at copies of simulated stations, several at the same time


@dataclass(frozen=True, slots=True)
class JobContext:
    """Context of one job for the function of its kind: arguments and progress reports.

    `hold` waits until no other job holds any of the given names; from then on this job holds them, and releases the
    names that it held before.
    """

    args: Args
    report_progress: Callable[
        [str], None
    ]  # at most 160 characters, ideally "... n of m"; raises TakenOver or Cancelled
    hold: Callable[[Collection[str]], None] = lambda names: None  # raises TakenOver or Cancelled


Kind = Callable[[JobContext], Args]
Least = Callable[[Args], Role]  # lowest role that may request a job with these args
Chore = Callable[[], object]


def _operators(args: Args) -> Role:
    return Role.OPERATOR


@dataclass(frozen=True, slots=True)
class Declared:
    """Declaration of a kind: its function, the role that may request it, and the requirements for a worker."""

    does: Kind
    least: Least = _operators
    queue: Queue = Queue.CPU
    folder: bool = True  # needs the lab's data folder
    start: str = ""  # where people start it, if they may not have a failed job tried again


_kinds: dict[str, Declared] = {}
_chores: dict[str, Chore] = {}
_starts: dict[str, Chore] = {}


class JobTakenOver(Exception):
    """Error if another worker has the job now: stop, and write nothing more."""


class Cancelled(Exception):
    """Error that ends a job function after a user has cancelled the job."""


class JobUnfinished(Exception):
    """Ends a job's execution that has done a part of the work: the job is queued again, behind those that wait.

    `after_s` is the time until then [s].
    """

    def __init__(self, after_s: float = 0.0) -> None:
        super().__init__(f"to be continued after {after_s:g} s")
        self.after_s = after_s


class UnknownKind(EvaError):
    """Error if no app has declared jobs of that kind."""


def job_kind(
    name: str, least: Least = _operators, *, queue: Queue = Queue.CPU, folder: bool = True, start: str = ""
) -> Callable[[Kind], Kind]:
    """Declare a kind of jobs: decorate the function that does such a job and returns its result as JSON.

    The function may be killed at any moment and run again, in the worst case by several workers at once: it must be
    idempotent. An exception becomes the error of the job, which is retried.

    Args:
        name: Name of the kind.
        least: Function that returns the role that may request a job with the given args.
        queue: Queue of workers that execute such jobs.
        folder: Whether such a job needs the lab's data folder, because it accesses recordings, datasets or records in
            place.
        start: Where people start such a job anew; "" if they may have a failed one tried again as it is.
    """

    def declare(function: Kind) -> Kind:
        _kinds[name] = Declared(function, least, queue, folder, start)
        return function

    return declare


def least_role(name: str, args: Args) -> Role:
    """Return the lowest role that may request a job of kind `name` with the arguments `args`."""
    return declared(name).least(args) if name in _kinds else Role.OPERATOR


def periodic_task(name: str) -> Callable[[Chore], Chore]:
    """Declare a cheap function that workers with the lab's data folder and queue `cpu` call every few seconds."""

    def declare(function: Chore) -> Chore:
        _chores[name] = function
        return function

    return declare


def startup_task(name: str) -> Callable[[Chore], Chore]:
    """Declare a function that workers with the lab's data folder and queue `cpu` call once when they start."""

    def declare(function: Chore) -> Chore:
        _starts[name] = function
        return function

    return declare


def declared(name: str) -> Declared:
    """Return the declaration of a kind. Raises: UnknownKind, which lists the declared ones."""
    if name not in _kinds:
        raise UnknownKind(
            f"no job of kind {name!r} is known; there are {', '.join(sorted(_kinds)) or 'none'}"
        )
    return _kinds[name]


def starts_elsewhere(name: str) -> bool:
    """Return True if people may not have a failed job of that kind tried again, because they start it elsewhere."""
    return name in _kinds and bool(_kinds[name].start)


def kind_named(name: str) -> Kind:
    """Return the function that does jobs of that kind. Raises: UnknownKind."""
    return declared(name).does


def without_folder() -> list[str]:
    """Return the names of the kinds that do not need the lab's data folder."""
    return sorted(name for name, kind in _kinds.items() if not kind.folder)


def periodic_tasks() -> Mapping[str, Chore]:
    """Return all periodic tasks by name."""
    return dict(_chores)


def startup_tasks() -> Mapping[str, Chore]:
    """Return all startup tasks by name."""
    return dict(_starts)
