"""How long this thread's connection waits while somebody else writes: for what must not be kept by a row."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from django.db import connection


@contextmanager
def lock_wait(seconds: float) -> Iterator[None]:
    """Within it a locked database is an OperationalError after `seconds`.

    SQLite alone locks as a whole; others lock rows, and nobody waits for another's.
    """
    if connection.vendor != "sqlite":
        yield
        return
    usual = float(connection.settings_dict["OPTIONS"].get("timeout", 5.0))
    _wait_at_most(seconds)
    try:
        yield
    finally:
        _wait_at_most(usual)


def _wait_at_most(seconds: float) -> None:
    with connection.cursor() as cursor:
        cursor.execute(f"PRAGMA busy_timeout = {int(seconds * 1000)}")
