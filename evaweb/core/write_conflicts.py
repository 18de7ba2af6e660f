"""Concurrent writes of the same key: the writer that is refused gets a clear message or a second attempt.

Without this module the refusal would be a server error. SQLite admits one writer at a time. On PostgreSQL two
transactions can both check that a name is free and insert it; the unique index then refuses the second one, after every
check.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from django.db import IntegrityError, connection

from runtime.core.sentences import fixed

TAKEN = fixed(
    "web.taken",
    "somebody else wrote the same at this moment, and nothing of yours was saved: look, then try again",
)
_UNIQUE_VIOLATION = "23505"  # PostgreSQL's sqlstate
_Given = ParamSpec("_Given")
_Found = TypeVar("_Found")


def is_duplicate(error: BaseException) -> bool:
    """Return True if a row was refused because its name, number or key exists already."""
    if not isinstance(error, IntegrityError):
        return False
    return getattr(error.__cause__, "sqlstate", "") == _UNIQUE_VIOLATION or "UNIQUE constraint" in str(error)


def once_more(write: Callable[_Given, _Found]) -> Callable[_Given, _Found]:
    """Decorate a function that writes in a transaction, so that it runs a second time if its row exists already.

    This happens when another process creates a row with the same unique value meanwhile. The second run then finds the
    other row. Within an outer transaction nothing is repeated.
    """

    @wraps(write)
    def written(*args: _Given.args, **kwargs: _Given.kwargs) -> _Found:
        try:
            return write(*args, **kwargs)
        except IntegrityError as error:
            if connection.in_atomic_block or not is_duplicate(error):
                raise
        return write(*args, **kwargs)

    return written
