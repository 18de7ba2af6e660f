"""Longest waits of a database connection, where a row, a lock or a server that hangs must not keep it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from django.db import connection, connections
from django.db.backends.signals import connection_created

HURRY_S = 1.5  # what a request that commands or renews waits for the database
_WEB_CONNECT_S = 2  # the least that PostgreSQL's library takes
_hurry: ContextVar[float | None] = ContextVar("hurry", default=None)


@contextmanager
def short_lock_wait(seconds: float = HURRY_S) -> Iterator[None]:
    """Connections that are opened within it wait no longer for a lock, nor for a statement of PostgreSQL's."""
    token = _hurry.set(seconds)
    try:
        yield
    finally:
        _hurry.reset(token)


@contextmanager
def lock_wait(seconds: float) -> Iterator[None]:
    """Within it a locked database is an OperationalError after `seconds`.

    SQLite locks as a whole. PostgreSQL locks rows, and a new one waits for those that it refers to.
    """
    _wait_at_most(connection, seconds if connection.vendor == "sqlite" else max(seconds, 0.001))
    try:
        yield
    finally:
        _wait_at_most(connection, _usual(connection))


def limit_page_waits() -> None:
    """This process serves people: it does not wait long for a PostgreSQL that does not answer.

    Other processes keep the time of the settings, and try again.
    """
    options: dict[str, Any] = connections.settings["default"]["OPTIONS"]
    if "connect_timeout" in options:
        options["connect_timeout"] = _WEB_CONNECT_S


def _usual(database: Any) -> float:
    patience = float(database.settings_dict["OPTIONS"].get("timeout", 5.0))
    hurry = _hurry.get()
    if database.vendor == "sqlite":
        return patience if hurry is None else min(hurry, patience)
    return hurry or 0.0


def _limit(connection: Any, **named: Any) -> None:
    """A connection that has just been opened."""
    hurry = _hurry.get()
    if hurry is None:
        return
    _wait_at_most(connection, hurry)
    if connection.vendor == "postgresql":
        with connection.cursor() as cursor:
            cursor.execute(f"SET statement_timeout = {int(hurry * 1000)}")


def _wait_at_most(database: Any, seconds: float) -> None:
    name = "PRAGMA busy_timeout" if database.vendor == "sqlite" else "SET lock_timeout"
    with database.cursor() as cursor:
        cursor.execute(f"{name} = {int(seconds * 1000)}")


connection_created.connect(_limit, dispatch_uid="evaweb.lock_wait")
