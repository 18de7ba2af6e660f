"""Base class of all errors about robot descriptions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robots.urdf import Urdf


class RobotError(Exception):
    """Error about a robot's folder; the message names file and key, the given value, and the allowed ones."""


@contextmanager
def error_context(key: str) -> Iterator[None]:
    """Prefix the message of each RobotError that is raised in this context with `key`."""
    try:
        yield
    except RobotError as error:
        raise RobotError(f"{key}: {error}") from error


def reject_duplicates(file: Path, key: str, given: list[str]) -> None:
    repeated = sorted({name for name in given if given.count(name) > 1})
    if repeated:
        raise RobotError(f"{file}: {key}: {', '.join(repeated)} more than once; each is allowed once")


def check_movers(key: str, tree: Urdf, names: Iterable[str]) -> None:
    for name in names:
        with error_context(key):
            joint = tree.joint(name)
        if not joint.is_independent:
            raise RobotError(f"{key}: {name} is fixed or a mimic; allowed: joints that move by themselves")
