"""Limits on how long a database connection waits for a lock or for an unresponsive server."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

from django.db import InterfaceError, OperationalError, connection, connections
from django.db.backends.signals import connection_created

log = logging.getLogger(__name__)

_Result = TypeVar("_Result")
WAITS_S = (0.2, 0.5, 1.0, 2.0, 5.0, 5.0, 5.0, 5.0)


def retry_while_locked(action: Callable[[], _Result]) -> _Result:
    """Return the result of `action`; retry while the database is locked or unreachable, for about 30 s.

    `action` must be a whole transaction, so that a failed attempt leaves nothing behind. Within an open transaction the
    error is raised at once.
    """
    for wait in WAITS_S:
        try:
            return action()
        except (OperationalError, InterfaceError) as error:
            if connection.in_atomic_block:
                raise
            log.warning("the database does not answer, again in %g s: %s", wait, error)
            connection.close()
            time.sleep(wait)
    return action()


HURRY_S = 1.5  # longest lock wait of requests that send commands or renew leases
_WEB_CONNECT_S = 2  # smallest connect timeout of libpq
_hurry: ContextVar[float | None] = ContextVar("hurry", default=None)


@contextmanager
def short_lock_wait(seconds: float = HURRY_S) -> Iterator[None]:
    """Limit how long database connections opened in this context wait for a lock to `seconds`.

    On PostgreSQL the duration of each statement is limited too.
    """
    token = _hurry.set(seconds)
    try:
        yield
    finally:
        _hurry.reset(token)


@contextmanager
def lock_wait(seconds: float) -> Iterator[None]:
    """Limit the time that a statement of the current connection waits for a lock to `seconds` [s].

    A statement that would wait longer raises OperationalError. SQLite locks the whole database. PostgreSQL locks rows,
    and an insert waits for the rows that it references.
    """
    _wait_at_most(connection, seconds if connection.vendor == "sqlite" else max(seconds, 0.001))
    try:
        yield
    finally:
        _wait_at_most(connection, _usual(connection))


def limit_page_waits() -> None:
    """Shorten the PostgreSQL connect timeout of this process, because it serves users.

    Other processes keep the timeout of the settings and retry.
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
    """Apply the limit of `short_lock_wait` to a newly opened connection."""
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


connection_created.connect(_limit, dispatch_uid="evaweb.core.lock_wait")
