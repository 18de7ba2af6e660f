"""Files that survive a kill: append-only files without partial writes, and documents renamed into place."""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from runtime.core.durable_files import write_durably
from runtime.core.errors import RecordingError
from runtime.recording.digests import Digest, FileDigest

_FULL = {errno.ENOSPC: "disk full", errno.EDQUOT: "disk quota used up"}
_OTHERS = {errno.EFBIG: "file too large"}


class DiskFullError(RecordingError):
    """Error of a full disk: no file of an episode can be written."""


class UnclosedError(DiskFullError):
    """Error that an episode's end did not fit on the disk.

    Call `again` to write the rest; it may raise the error anew.
    """

    def __init__(self, why: str, again: Callable[[], None]) -> None:
        super().__init__(why)
        self.again = again


class AppendFile:
    """File that only grows, by whole writes: a write that fails midway is undone.

    One thread writes; another may sync at the same time. Disk errors become RecordingError. Its digest has pieces of at
    least `least` rows.
    """

    def __init__(self, path: Path, least: int = 1) -> None:
        self.path = path
        self._digest = Digest(least)
        self.size = 0
        self._synced = 0
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise disk_error("creating", path, error) from error

    @property
    def digest(self) -> FileDigest:
        """Digest of the written bytes; read it after the last write."""
        return self._digest.to_dict()

    def write(self, data: bytes | bytearray | memoryview, rows: int = 0) -> None:
        """Append all of `data`, which has `rows` rows or lines, or nothing. Raises RecordingError."""
        view = memoryview(data)
        written = 0
        try:
            while written < len(view):
                written += os.write(self._descriptor, view[written:])
        except OSError as error:
            if written:  # part of a record would hide all later records from a reader
                self._cut()
            raise disk_error("writing", self.path, error) from error
        self.size += written
        self._digest.add(data, rows)

    def sync(self) -> None:
        """Wait until the written bytes are on the disk; return at once if none were written since the last call."""
        size = self.size
        if size == self._synced:
            return
        try:
            os.fdatasync(self._descriptor)
        except OSError as error:
            raise disk_error("syncing", self.path, error) from error
        self._synced = size

    def _cut(self) -> None:
        try:
            os.ftruncate(self._descriptor, self.size)
            os.lseek(self._descriptor, self.size, os.SEEK_SET)
        except OSError as error:
            raise disk_error("cutting half a write from", self.path, error) from error

    def close(self) -> None:
        """Close without syncing."""
        os.close(self._descriptor)


def disk_error(doing: str, path: Path, error: OSError) -> RecordingError:
    """Return the error to raise for `error`, with its cause, the file and the free space.

    It is a DiskFullError if the disk or quota is full.
    """
    full = _FULL.get(error.errno or 0)
    cause = full or _OTHERS.get(error.errno or 0, "disk error")
    reason = error.strerror or str(error)
    folder = _existing(path)
    try:
        room = f"{shutil.disk_usage(folder).free} bytes free in {folder}"
    except OSError as unknown:
        room = f"free space of {folder} unknown ({unknown.strerror})"
    return (DiskFullError if full else RecordingError)(f"{cause} while {doing} {path}: {reason}; {room}")


def require_room(folder: Path, wanted: int) -> None:
    """Raise RecordingError if the disk of `folder` has less than `wanted` bytes free."""
    try:
        free = shutil.disk_usage(_existing(folder)).free
    except OSError as error:
        raise disk_error("measuring", folder, error) from error
    if free < wanted:
        raise RecordingError(
            f"too little room to record in {folder}: {free} bytes free, at least {wanted} wanted "
            "(recording.min_free_bytes); free some space or record elsewhere"
        )


def write_atomic(path: Path, data: bytes) -> None:
    """Replace the file at `path` durably by `write_durably`. Raises RecordingError or DiskFullError."""
    try:
        write_durably(path, data)
    except OSError as error:
        raise disk_error("writing", path, error) from error


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Hold a lock on `folder`, created if absent, while the context is open; wait if another process holds it.

    The kernel releases the lock however the process ends. Raises RecordingError.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise disk_error("creating", folder, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def to_json(value: Mapping[str, object], name: str, *, indent: int | None = None) -> bytes:
    """Return `value` as JSON; numpy values become plain values, numbers that are not finite become null."""
    try:
        return json.dumps(_to_builtin(value), indent=indent, ensure_ascii=False, allow_nan=False).encode()
    except (TypeError, ValueError, UnicodeEncodeError) as error:
        raise RecordingError(f"{name} cannot be written as JSON: {error}") from error


def read_json(path: Path) -> dict[str, object]:
    """Return the JSON object in `path`. Raises RecordingError if it is absent, torn or not an object."""
    try:
        value = json.loads(path.read_bytes())
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path} is not a whole JSON document: {error}") from error
    if not isinstance(value, dict):
        raise RecordingError(f"{path} holds {type(value).__name__}, must hold one JSON object")
    return value


def _to_builtin(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _to_builtin(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_to_builtin(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _to_builtin(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def _existing(path: Path) -> Path:
    return next((folder for folder in (path, *path.parents) if folder.is_dir()), Path("/"))
