"""A database without its guards, for tests that lose it or tamper with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from django.apps import apps
from django.db import connection

from evaweb.records.append_only import guards, install, removal


@contextmanager
def without_triggers(*labels: str) -> Iterator[None]:
    """The tables of these apps, as for somebody who has the file."""
    declared = [guard for label in labels for guard in guards(apps.get_app_config(label))]
    with connection.cursor() as cursor:
        for guard in declared:
            for statement in removal(connection, guard):
                cursor.execute(statement)
    yield
    install(connection, declared)
