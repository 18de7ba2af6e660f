"""Journal of a process: intended database writes, recovered by another process if it dies."""

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
_NO_FILE = (
    errno.EACCES,
    errno.EPERM,
    errno.ELOOP,
    errno.ENXIO,
)  # permanent errors: not a file of this process


class ProcessJournal:
    """One file of lines, locked as long as this process lives; removed while nothing is pending.

    Writes are not synced: data handed to the kernel survives the process, though not the machine.
    """

    def __init__(self, folder: Callable[[], Path]) -> None:
        self._folder = folder
        self._path: Path | None = None
        self._file: BinaryIO | None = None

    def add(self, documents: Iterable[Any]) -> None:
        """Append one line of JSON per document. Raises: OSError."""
        lines = b"".join(json.dumps(document).encode() + b"\n" for document in documents)
        if self._file is None:
            self._path, self._file = self._begun()
        self._file.write(lines)

    def clear(self) -> None:
        """Remove the file, because everything in it is stored elsewhere. Raises: OSError."""
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
            fcntl.flock(file, fcntl.LOCK_EX)  # lock it before it gets the name that recovery searches for
            os.replace(draft, path)
        except OSError:
            file.close()
            raise
        return path, file


def recover_journals(folder: Path, take: Callable[[Sequence[bytes]], bool]) -> bool:
    """Pass the lines of each dead process's journal to `take`.

    The file is removed if `take` returns True (all lines were valid); else it is renamed to .refused, as is anything
    that is not a regular file.
    Returns: True if a file could not be read or removed yet because of the disk.
    """
    waits = False
    for path in sorted(folder.glob(f"*{_SUFFIX}")):
        try:
            _resume(path, take)
        except (FileNotFoundError, BlockingIOError):
            continue  # another process has recovered it, or its owner lives
        except OSError as error:
            log.info("%s waits for the disk: %s", path, error)
            waits = True
        except Exception as fault:  # a file may contain anything: continue with the next
            _put_aside(path, repr(fault))
    return waits


def _resume(path: Path, take: Callable[[Sequence[bytes]], bool]) -> None:
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


def _put_aside(path: Path, reason: str | None) -> None:
    refused = path.replace(path.with_suffix(".refused"))
    log.error("%s is put aside as %s: %s", path, refused.name, reason)
