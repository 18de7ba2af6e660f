"""Texts of people, and files of lines that only grow, from which the database can be restored: scores, reviews."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evaweb.errors import EvaError


class NotKept(EvaError):
    """The disk did not take it, and so the database was not told either."""

    status = 507


def text(name: str, given: str, longest: int) -> str:
    """A text as it was typed, without blanks at its ends; EvaError where it cannot be stored."""
    if "\x00" in given:
        raise EvaError(f"{name} contains the character U+0000, which no database keeps: remove it")
    stripped = given.strip()
    if len(stripped) > longest:
        raise EvaError(f"{name} has {len(stripped)} characters; allowed: at most {longest}")
    return stripped


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Add one line and wait until it is on the disk; a line torn by a crash before it stays a line of its own.

    The caller holds a row of the database, so that there is one writer at a time. Raises NotKept.
    """
    text = json.dumps(line, allow_nan=False, separators=(",", ":"))  # ASCII: no character in it ends a line
    try:
        _written(path, text.encode() + b"\n")
    except OSError as error:
        raise NotKept(f"not kept: {error.strerror} ({path}); nothing was changed") from error


def _written(path: Path, payload: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        new = file.tell() == 0
        if not new:
            file.seek(-1, os.SEEK_END)
            payload = payload if file.read(1) == b"\n" else b"\n" + payload
        file.write(payload)
        file.flush()
        os.fsync(file.fileno())
    if new:
        _sync_folder(path.parent)
        _sync_folder(path.parent.parent)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
