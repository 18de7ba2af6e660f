"""Rows that the database itself refuses to change or remove, whatever program asks it to.

Installed after every migration, because SQLite loses a table's triggers when a migration rebuilds it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from django.apps import AppConfig
from django.db import connections
from django.db.models.signals import post_migrate


@dataclass(frozen=True, slots=True)
class Guard:
    """What of `table` stays: the values of `columns`, and the row. `message` is what whoever tries is told."""

    table: str
    columns: tuple[str, ...]
    message: str
    only: str = ""  # SQL about OLD: which rows are kept; all where it is empty

    @property
    def names(self) -> tuple[str, str]:
        """Its triggers: against changes, against removal."""
        return (f"{self.table}_kept", f"{self.table}_never_removed")


def install(connection: Any, guards: Iterable[Guard]) -> None:
    """Make the triggers anew, as they are declared now; other databases than SQLite and PostgreSQL are refused."""
    make = {"sqlite": _sqlite, "postgresql": _postgresql}.get(connection.vendor)
    if make is None:
        raise NotImplementedError(f"a database of {connection.vendor}; allowed: sqlite, postgresql")
    with connection.cursor() as cursor:
        for guard in guards:
            for statement in (*removal(connection, guard), *make(guard)):
                cursor.execute(statement)


def keep(app: AppConfig, guards: Iterable[Guard]) -> None:
    """Have `guards` installed whenever the tables of `app` were migrated."""

    def guard(sender: AppConfig, using: str, **named: Any) -> None:
        install(connections[using], guards)

    post_migrate.connect(guard, sender=app, weak=False, dispatch_uid=f"guards of {app.name}")


def removal(connection: Any, guard: Guard) -> list[str]:
    """What takes the triggers of a guard away."""
    of = f" ON {guard.table}" if connection.vendor == "postgresql" else ""
    return [f"DROP TRIGGER IF EXISTS {name}{of}" for name in guard.names]


def _sqlite(guard: Guard) -> list[str]:
    refusal = f"BEGIN SELECT RAISE(ABORT, '{guard.message}'); END"
    changed = " OR ".join(f'OLD."{column}" IS NOT NEW."{column}"' for column in guard.columns)
    kept = f"({guard.only}) AND ({changed})" if guard.only else changed
    removed = f" WHEN {guard.only}" if guard.only else ""
    return [
        f"CREATE TRIGGER {guard.names[0]} BEFORE UPDATE ON {guard.table} WHEN {kept} {refusal}",
        f"CREATE TRIGGER {guard.names[1]} BEFORE DELETE ON {guard.table}{removed} {refusal}",
    ]


def _postgresql(guard: Guard) -> list[str]:
    changed = " OR ".join(f'OLD."{column}" IS DISTINCT FROM NEW."{column}"' for column in guard.columns)
    kept = f"({guard.only}) AND ({changed})" if guard.only else changed
    removed = f" WHEN ({guard.only})" if guard.only else ""
    return [
        "CREATE OR REPLACE FUNCTION eva_kept() RETURNS trigger LANGUAGE plpgsql AS $$ "
        "BEGIN RAISE EXCEPTION USING ERRCODE = 'integrity_constraint_violation', MESSAGE = TG_ARGV[0]; END $$",
        f"CREATE TRIGGER {guard.names[0]} BEFORE UPDATE ON {guard.table} FOR EACH ROW WHEN ({kept}) "
        f"EXECUTE FUNCTION eva_kept('{guard.message}')",
        f"CREATE TRIGGER {guard.names[1]} BEFORE DELETE ON {guard.table} FOR EACH ROW{removed} "
        f"EXECUTE FUNCTION eva_kept('{guard.message}')",
    ]
