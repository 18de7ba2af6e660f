"""The tests' database as every test begins with it: what migrations wrote, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import pytest
from django.apps import apps
from django.core.management.color import no_style
from django.db import DEFAULT_DB_ALIAS, connections, transaction

from evaweb.records.append_only import guards, install, removal

Rows = Mapping[str, tuple[tuple[Any, ...], ...]]  # by table, in the order of their keys


class AsMigrated:
    """Made of a database that was migrated just now; it empties it down to that, and tells what differs."""

    def __init__(self, alias: str = DEFAULT_DB_ALIAS) -> None:
        self._alias = alias
        self._columns: dict[str, list[str]] = {}
        for model in apps.get_models(include_auto_created=True):
            meta = model._meta
            if meta.managed and not meta.proxy:
                self._columns[meta.db_table] = [
                    meta.pk.column,
                    *(field.column for field in meta.concrete_fields if not field.primary_key),
                ]
        self._written = {table: rows for table, rows in self._now(self._columns).items() if rows}

    def empty(self) -> None:
        """What a test with transactions left is gone, guarded or not, and what migrations wrote is there."""
        database = connections[self._alias]
        tables = sorted(self._columns.keys() - self._written.keys())
        emptied = database.ops.sql_flush(no_style(), tables)
        if database.vendor == "postgresql":  # which refuses to empty guarded tables at all
            role = "SET session_replication_role = "
            database.ops.execute_sql_flush([f"{role}replica", *emptied, f"{role}DEFAULT"])
        else:
            declared = [guard for app in apps.get_app_configs() for guard in guards(app)]
            in_the_way = [guard for guard in declared if self._any(guard.table)]
            lifted = [statement for guard in in_the_way for statement in removal(database, guard)]
            database.ops.execute_sql_flush([*lifted, *emptied])
            install(database, in_the_way)
        self._write_again(self.changed())

    def changed(self) -> list[str]:
        """The tables whose rows are not those that migrations wrote; those without any are not looked at."""
        now = self._now(self._written)
        return [table for table, rows in self._written.items() if now[table] != rows]

    def check(self) -> None:
        """After a test: it is named that left other rows than migrations wrote. The next one has those again."""
        if changed := self.changed():
            self._write_again(changed)
            pytest.fail(f"the test left other rows than migrations wrote: {', '.join(changed)}")

    def _now(self, tables: Iterable[str]) -> Rows:
        rows = {}
        with connections[self._alias].cursor() as cursor:
            for table in tables:
                names = ", ".join(f'"{name}"' for name in self._columns[table])
                cursor.execute(f'SELECT {names} FROM "{table}" ORDER BY 1')
                rows[table] = tuple(map(tuple, cursor.fetchall()))
        return rows

    def _any(self, table: str) -> bool:
        with connections[self._alias].cursor() as cursor:
            cursor.execute(f'SELECT 1 FROM "{table}" LIMIT 1')
            return cursor.fetchone() is not None

    def _write_again(self, tables: Iterable[str]) -> None:
        """What refers to them refers to the same keys afterwards."""
        with transaction.atomic(self._alias), connections[self._alias].cursor() as cursor:
            for table in tables:
                names = ", ".join(f'"{name}"' for name in self._columns[table])
                marks = ", ".join(["%s"] * len(self._columns[table]))
                cursor.execute(f'DELETE FROM "{table}"')
                cursor.executemany(
                    f'INSERT INTO "{table}" ({names}) VALUES ({marks})', list(self._written[table])
                )


CHECK = pytest.StashKey[Callable[[], None]]()  # in the session's configuration, while there is a database
