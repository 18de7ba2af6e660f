"""Kinds of jobs; apps declare theirs in a module `job_kinds`, this one knows none of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from evaweb.errors import EvaError
from evaweb.roles import Role

Args = Mapping[str, Any]


class Queue(StrEnum):
    """What a machine must have to do a job, apart from the lab's data folder."""

    CPU = "cpu"  # processors, and a disk that is fast enough for recordings
    GPU = "gpu"  # an accelerator, or a way to the server that has it
    STATION = "station"  # the deployment files of this lab's stations, and a way to their policy servers


@dataclass(frozen=True, slots=True)
class JobContext:
    """One job as its kind sees it: what is asked for, and how to say how far it is.

    `hold` waits until no other job holds any of these names, and holds them instead of what this one held before.
    """

    args: Args
    report_progress: Callable[
        [str], None
    ]  # at most 160 characters, best "... n of m"; raises TakenOver or Cancelled
    hold: Callable[[Collection[str]], None] = lambda names: None  # raises as `tell` does


Kind = Callable[[JobContext], Args]
Least = Callable[[Args], Role]  # who may ask for such a job
Chore = Callable[[], object]


def _operators(args: Args) -> Role:
    return Role.OPERATOR


@dataclass(frozen=True, slots=True)
class Declared:
    """A kind: what does it, who may ask for it, and what a worker needs for it."""

    does: Kind
    least: Least = _operators
    queue: Queue = Queue.CPU
    folder: bool = True  # the lab's data folder


_kinds: dict[str, Declared] = {}
_chores: dict[str, Chore] = {}
_starts: dict[str, Chore] = {}


class TakenOver(Exception):
    """Another worker has the job now: what is under way ends here, and nothing more is written."""


class Cancelled(Exception):
    """Somebody has asked for the end of the job: what is under way ends here."""


class UnknownKind(EvaError):
    """No app of this program does jobs of that kind."""


def job_kind(
    name: str, least: Least = _operators, *, queue: Queue = Queue.CPU, folder: bool = True
) -> Callable[[Kind], Kind]:
    """Declare a kind: a function that does it and returns its result as JSON.

    It may be ended at any moment and done again, by several workers at once in the worst case: it must leave
    the same as if it had been done once. What it raises is the error of the job, and it is tried again.
    `least` is the role that may ask for one with such args. Workers that take `queue` do it, where there is `folder`
    only those that have the lab's data folder: recordings, datasets and records are read and written in place.
    """

    def declare(function: Kind) -> Kind:
        _kinds[name] = Declared(function, least, queue, folder)
        return function

    return declare


def least_role(name: str, args: Args) -> Role:
    """The role that may ask for such a job."""
    return declared(name).least(args) if name in _kinds else Role.OPERATOR


def periodic_task(name: str) -> Callable[[Chore], Chore]:
    """Declare something cheap that workers of the lab's data folder that take `cpu` look after every few seconds."""

    def declare(function: Chore) -> Chore:
        _chores[name] = function
        return function

    return declare


def startup_task(name: str) -> Callable[[Chore], Chore]:
    """Declare what workers of the lab's data folder that take `cpu` do once, when they start."""

    def declare(function: Chore) -> Chore:
        _starts[name] = function
        return function

    return declare


def declared(name: str) -> Declared:
    """The kind of that name; UnknownKind lists those there are."""
    if name not in _kinds:
        raise UnknownKind(
            f"no job of kind {name!r} is known; there are {', '.join(sorted(_kinds)) or 'none'}"
        )
    return _kinds[name]


def kind_named(name: str) -> Kind:
    """The function that does jobs of that kind; UnknownKind lists those there are."""
    return declared(name).does


def without_folder() -> list[str]:
    """Names of the kinds that do not need the lab's data folder."""
    return sorted(name for name, kind in _kinds.items() if not kind.folder)


def periodic_tasks() -> Mapping[str, Chore]:
    """All chores by name."""
    return dict(_chores)


def startup_tasks() -> Mapping[str, Chore]:
    """All that is done once, by name."""
    return dict(_starts)
