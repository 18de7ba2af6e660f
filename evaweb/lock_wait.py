"""How long this thread's connection waits while somebody else writes: for what must not be kept by a row."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from django.db import connection


@contextmanager
def lock_wait(seconds: float) -> Iterator[None]:
    """Within it a locked database is an OperationalError after `seconds`.

    SQLite locks as a whole. PostgreSQL locks rows, and a new one waits for those that it refers to.
    """
    sqlite = connection.vendor == "sqlite"
    _wait_at_most(seconds if sqlite else max(seconds, 0.001))
    try:
        yield
    finally:
        _wait_at_most(float(connection.settings_dict["OPTIONS"].get("timeout", 5.0)) if sqlite else 0.0)


def _wait_at_most(seconds: float) -> None:
    name = "PRAGMA busy_timeout" if connection.vendor == "sqlite" else "SET lock_timeout"
    with connection.cursor() as cursor:
        cursor.execute(f"{name} = {int(seconds * 1000)}")
