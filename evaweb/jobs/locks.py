"""One lock file per running job, held by the kernel for as long as the worker's process lives.

Two jobs with the same key never run at the same time on one disk. The death of a worker is detected immediately if the
lock proves it: the lock is free, and this same kernel granted it. Otherwise the times in the database decide.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from uuid import UUID

from django.conf import settings

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # changes with each boot
_TRIES, _AGAIN_S = 20, 0.05  # a check by another worker holds a lock for a moment


class ClaimantState(Enum):
    """State of the worker that claimed a job, as known from the job's lock."""

    ALIVE = "at work"
    ENDED = "ended without a word"
    UNKNOWN = "not known here"


@contextmanager
def exclusive_job(key: str, owner: UUID | None) -> Iterator[bool]:
    """Hold the lock of a job during the block; yield False if another process holds it."""
    path = _path(key)
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = _locked(path)
    if descriptor is None:
        yield False
        return
    try:
        os.ftruncate(descriptor, 0)
        os.write(descriptor, _mark(owner))
        yield True
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def claimant_state(key: str, owner: UUID | None) -> ClaimantState:
    """Return the state of `owner`, which has claimed the job with that key."""
    try:
        descriptor = os.open(_path(key), os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return ClaimantState.UNKNOWN
    try:
        if not _taken(descriptor):
            return ClaimantState.ALIVE
        return ClaimantState.ENDED if os.read(descriptor, 200) == _mark(owner) else ClaimantState.UNKNOWN
    finally:
        os.close(descriptor)


def _path(key: str) -> Path:
    return Path(settings.DATA_DIR) / "jobs" / hashlib.sha256(key.encode()).hexdigest()[:32]


def _mark(owner: UUID | None) -> bytes:
    """Return the content of a lock file: the owner of the job, and the boot id of the kernel that granted the lock.

    The boot id is needed because locks of another machine may not be visible on this one.
    """
    return f"{owner} {_BOOT_ID.read_text().strip()}".encode()


def _locked(path: Path) -> int | None:
    """Lock the file at `path` and return its descriptor; None if another process holds the lock at every attempt.

    After locking, `path` must still name the opened file: it may have been removed and created anew in between.
    """
    for attempt in range(_TRIES):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        if _taken(descriptor) and path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
            return descriptor
        os.close(descriptor)
        if attempt + 1 < _TRIES:
            time.sleep(_AGAIN_S)
    return None


def _taken(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
