"""What a process has in mind to write down, as lines of a file: whoever looks after its death finds them."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import stat
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

log = logging.getLogger(__name__)
_SUFFIX = ".lines"
_NO_FILE = (errno.EACCES, errno.EPERM, errno.ELOOP, errno.ENXIO)  # of this process, and never will be


class ProcessJournal:
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


def recover_journals(folder: Path, take: Callable[[Sequence[bytes]], bool]) -> bool:
    """Hand `take` the lines of each process that has died; whether a file has to wait for the disk.

    A file is removed when `take` says that all of it was good; else it stays as .refused, as does what is no file.
    """
    waits = False
    for path in sorted(folder.glob(f"*{_SUFFIX}")):
        try:
            _take_up(path, take)
        except (FileNotFoundError, BlockingIOError):
            continue  # another process has taken it up, or its own lives
        except OSError as error:
            log.info("%s waits for the disk: %s", path, error)
            waits = True
        except Exception as fault:  # a file may hold anything: the next one is looked at all the same
            _put_aside(path, repr(fault))
    return waits


def _take_up(path: Path, take: Callable[[Sequence[bytes]], bool]) -> None:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW)
    except OSError as error:
        if error.errno not in _NO_FILE:
            raise
        _put_aside(path, error.strerror)
        return
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            _put_aside(path, "it is no file")
            return
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with open(descriptor, "rb", closefd=False) as file:
            content = file.read()
        lines = content.removesuffix(b"\n").split(b"\n") if content else []
        if take(lines):
            path.unlink(missing_ok=True)
        else:
            _put_aside(path, "it has lines that are not ours")
    finally:
        os.close(descriptor)


def _put_aside(path: Path, why: str | None) -> None:
    aside = path.replace(path.with_suffix(".refused"))
    log.error("%s is put aside as %s: %s", path, aside.name, why)
