"""Kinds of jobs; apps declare theirs in a module `job_kinds`, this one knows none of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from evaweb.errors import EvaError

Args = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Work:
    """One job as its kind sees it: what is asked for, and how to say how far it is."""

    args: Args
    tell: Callable[[str], None]  # at most 160 characters; raises TakenOver


Kind = Callable[[Work], Args]
Chore = Callable[[], object]

_kinds: dict[str, Kind] = {}
_chores: dict[str, Chore] = {}
_starts: dict[str, Chore] = {}


class TakenOver(Exception):
    """Another worker has the job now: what is under way ends here, and nothing more is written."""


class UnknownKind(EvaError):
    """No app of this program does jobs of that kind."""


def job_kind(name: str) -> Callable[[Kind], Kind]:
    """Declare a kind: a function that does it and returns its result as JSON.

    It may be ended at any moment and done again, by several workers at once in the worst case: it must leave
    the same as if it had been done once. What it raises is the error of the job, and it is tried again.
    """

    def declare(function: Kind) -> Kind:
        _kinds[name] = function
        return function

    return declare


def chore(name: str) -> Callable[[Chore], Chore]:
    """Declare something cheap that every worker looks after every few seconds."""

    def declare(function: Chore) -> Chore:
        _chores[name] = function
        return function

    return declare


def at_start(name: str) -> Callable[[Chore], Chore]:
    """Declare what every worker does once, when it starts."""

    def declare(function: Chore) -> Chore:
        _starts[name] = function
        return function

    return declare


def kind_named(name: str) -> Kind:
    """The function that does jobs of that kind; UnknownKind lists those there are."""
    if name not in _kinds:
        raise UnknownKind(
            f"no job of kind {name!r} is known; there are {', '.join(sorted(_kinds)) or 'none'}"
        )
    return _kinds[name]


def chores() -> Mapping[str, Chore]:
    """All chores by name."""
    return dict(_chores)


def starts() -> Mapping[str, Chore]:
    """All that is done once, by name."""
    return dict(_starts)
