"""What a process has in mind to write down, as lines of a file: whoever looks after its death finds them."""

from __future__ import annotations

import fcntl
import json
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

log = logging.getLogger(__name__)
_SUFFIX = ".lines"


class Journal:
    """One file at a time, locked as long as this process lives; there is none while nothing is in mind.

    Nothing is synced: what the system has taken outlives the process, if not the machine.
    """

    def __init__(self, folder: Callable[[], Path]) -> None:
        self._folder = folder
        self._path: Path | None = None
        self._file: BinaryIO | None = None

    def add(self, documents: Iterable[Any]) -> None:
        """A line of JSON for each; OSError."""
        lines = b"".join(json.dumps(document).encode() + b"\n" for document in documents)
        if self._file is None:
            self._path, self._file = self._begun()
        self._file.write(lines)

    def clear(self) -> None:
        """All of it is written down otherwise; OSError."""
        if self._file is None or self._path is None:
            return
        self._path.unlink(missing_ok=True)
        self._file.close()
        self._file = None

    def _begun(self) -> tuple[Path, BinaryIO]:
        folder = self._folder()
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{uuid4()}{_SUFFIX}"
        draft = path.with_suffix(".draft")
        file = draft.open("ab", buffering=0)
        try:
            fcntl.flock(file, fcntl.LOCK_EX)  # before it has the name that is looked for
            os.replace(draft, path)
        except OSError:
            file.close()
            raise
        return path, file


def left_in(folder: Path) -> Iterator[list[Any]]:
    """What each process that has died had in mind; removed where the caller comes back for the next one."""
    for path in sorted(folder.glob(f"*{_SUFFIX}")):
        try:
            file = path.open("rb")
        except FileNotFoundError:
            continue  # another process has taken it up
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue  # its process lives
            yield list(_documents(path, file.read()))
            path.unlink(missing_ok=True)


def _documents(path: Path, content: bytes) -> Iterator[Any]:
    for line in content.splitlines():
        try:
            yield json.loads(line)
        except ValueError:
            log.error("%s: this is no line of JSON: %.999r", path, line)
