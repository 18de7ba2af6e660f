"""Rows that the database itself refuses to change or remove, whatever program asks it to.

A model says so by `append_only = AppendOnly(...)`. Triggers are installed after every migration, because SQLite loses a
table's when a migration rebuilds it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from django.apps import AppConfig
from django.db import connections
from django.db.models import AutoField, Model
from django.db.models.signals import post_migrate


@dataclass(frozen=True, slots=True)
class AppendOnly:
    """What of a model's rows is never changed: all columns `but` some, or `columns` alone; nor is a row removed.

    `message` is what whoever tries is told. `only`: SQL about OLD, which rows that holds for; all where it is empty.
    """

    message: str
    columns: tuple[str, ...] = ()
    but: tuple[str, ...] = ()
    only: str = ""

    def guard(self, model: type[Model]) -> Guard:
        """The same as the database knows it."""
        for name in (*self.columns, *self.but):
            model._meta.get_field(name)  # or FieldDoesNotExist
        columns = tuple(
            field.column
            for field in model._meta.concrete_fields
            if (field.name in self.columns if self.columns else field.name not in self.but)
            and not isinstance(field, AutoField)
        )
        return Guard(model._meta.db_table, columns, self.message, self.only)


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


def protect(app: AppConfig) -> None:
    """Have what the models of `app` declare installed whenever its tables were migrated."""

    def install_guards(sender: AppConfig, using: str, **named: Any) -> None:
        install(connections[using], guards(app))

    post_migrate.connect(install_guards, sender=app, weak=False, dispatch_uid=f"guards of {app.name}")


def guards(app: AppConfig) -> tuple[Guard, ...]:
    """What the models of `app` declare."""
    return tuple(
        model.append_only.guard(model) for model in app.get_models() if hasattr(model, "append_only")
    )


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
