"""Two who write the same at one moment: one of them hears so, or what is wrong with it now, and never of a fault.

SQLite lets one writer in at a time. PostgreSQL lets both look, find a name free and write it: the second is refused by
the unique index, after every check.
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


def was_taken(error: BaseException) -> bool:
    """True if a row was refused because there is another one of its name, number or key."""
    if not isinstance(error, IntegrityError):
        return False
    return getattr(error.__cause__, "sqlstate", "") == _UNIQUE_VIOLATION or "UNIQUE constraint" in str(error)


def once_more(write: Callable[_Given, _Found]) -> Callable[_Given, _Found]:
    """Have a whole transaction done again, once, where another one took its name: it then sees that one's row."""

    @wraps(write)
    def written(*args: _Given.args, **kwargs: _Given.kwargs) -> _Found:
        try:
            return write(*args, **kwargs)
        except IntegrityError as error:
            if connection.in_atomic_block or not was_taken(error):
                raise
        return write(*args, **kwargs)

    return written
