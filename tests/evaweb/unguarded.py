"""A database without its guards, for tests that lose it or tamper with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from django.db import connection

from evaweb.append_only import Guard, install, removal


@contextmanager
def unguarded(guards: tuple[Guard, ...]) -> Iterator[None]:
    """As for somebody who has the file."""
    with connection.cursor() as cursor:
        for guard in guards:
            for statement in removal(connection, guard):
                cursor.execute(statement)
    yield
    install(connection, guards)
