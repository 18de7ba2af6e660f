"""Mapping of database and disk errors to a message and an HTTP status."""

from __future__ import annotations

import errno

from django.db import DatabaseError, Error, InterfaceError, InternalError, OperationalError

from runtime.core.sentences import Pattern, fixed

_FULL = ("disk is full", "disk full", "no space left")
_READ_ONLY = ("readonly", "read-only")
_DISK_FULL = fixed(
    "storage.disk_full",
    "the disk of the lab is full: the database was not changed. Make room there, and try again",
)
_CANNOT_WRITE = Pattern(
    "storage.cannot_write",
    "the lab's data cannot be written ({fault}): the database was not changed. Ask an administrator",
)
_DATABASE_AWAY = fixed(
    "storage.database_away",
    "the database is busy or gone: it was not changed, try again",
)


def storage_error_response(fault: BaseException | None) -> tuple[str, int] | None:
    """Return message and status (507 disk full, 503 disk or database unavailable); None for other errors."""
    if not isinstance(fault, Error | OSError):
        return None
    text = str(fault).lower()
    if getattr(fault, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or any(word in text for word in _FULL):
        return _DISK_FULL, 507
    if getattr(fault, "errno", None) == errno.EROFS or any(word in text for word in _READ_ONLY):
        return _CANNOT_WRITE(fault=fault), 503
    if isinstance(fault, OperationalError | InterfaceError | InternalError) or type(fault) is DatabaseError:
        return _DATABASE_AWAY, 503  # the log names the database
    return None
