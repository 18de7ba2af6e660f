"""Rows that the database refuses to change or delete, whichever program tries.

A model declares this by `append_only = AppendOnly(...)`. Triggers are installed after every migration, because SQLite
drops the triggers of a table that a migration rebuilds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from django.apps import AppConfig
from django.db import connections
from django.db.models import Model
from django.db.models.signals import post_migrate


@dataclass(frozen=True, slots=True)
class AppendOnly:
    """Declaration of the immutable part of a model's rows. A row is never deleted either.

    The conditions are SQL about the rows OLD and NEW, before and after a statement.

    Attributes:
        message: Text of the database error.
        columns: Protected columns; if empty, all except `except_columns`.
        except_columns: Columns that may change.
        condition: Condition about OLD for a row to be protected; "" protects all rows.
        allowed_changes: By column, the values that may follow each value. A value that is not listed may change to any.
        never: Conditions about OLD and NEW; an update is refused if any of them is true.
        forbidden_inserts: Condition about NEW; an insert is refused if it is true.
    """

    message: str
    columns: tuple[str, ...] = ()
    except_columns: tuple[str, ...] = ()
    condition: str = ""
    allowed_changes: Mapping[str, Mapping[str, Sequence[str]]] = field(default_factory=dict)
    never: tuple[str, ...] = ()
    forbidden_inserts: str = ""

    def guard(self, model: type[Model]) -> TriggerSpec:
        """Return the triggers of `model` in terms of tables and columns. Raises: FieldDoesNotExist."""
        for name in (*self.columns, *self.except_columns, *self.allowed_changes):
            model._meta.get_field(name)  # raises FieldDoesNotExist for a misspelt declaration
        columns = tuple(
            field.column
            for field in model._meta.concrete_fields
            if field.primary_key
            or (field.name in self.columns if self.columns else field.name not in self.except_columns)
        )
        moved = tuple(
            f'OLD."{name}" = \'{before}\' AND NEW."{name}" NOT IN ({", ".join(map(repr, (before, *after)))})'
            for name, table in self.allowed_changes.items()
            for before, after in table.items()
        )
        never = (*moved, *self.never)
        return TriggerSpec(
            model._meta.db_table, columns, self.message, self.condition, never, self.forbidden_inserts
        )


@dataclass(frozen=True, slots=True)
class TriggerSpec:
    """Append-only triggers of `table`: they protect rows and the values of `columns`; `message` is the error text."""

    table: str
    columns: tuple[str, ...]
    message: str
    only: str = ""  # SQL about OLD: protected rows; all if empty
    never: tuple[str, ...] = ()  # SQL about OLD and NEW: forbidden updates
    late: str = ""  # SQL about NEW: forbidden inserts

    @property
    def names(self) -> Mapping[str, str]:
        """Names of the triggers by SQL event (UPDATE, DELETE, INSERT, TRUNCATE)."""
        names = {
            "UPDATE": "kept",
            "DELETE": "never_removed",
            "INSERT": "complete",
            "TRUNCATE": "never_emptied",
        }
        return {event: f"{self.table}_{name}" for event, name in names.items()}

    def refused(self, different: str) -> Mapping[str, str]:
        """Return by SQL event (UPDATE, DELETE, INSERT) the condition about OLD and NEW under which such a statement is
        refused.

        Args:
            different: The NULL-safe inequality operator of the database.
        """
        changed = " OR ".join(f'OLD."{column}" {different} NEW."{column}"' for column in self.columns)
        protected = f"({self.only or 'TRUE'}) AND ({changed})"
        update = " OR ".join(f"({condition})" for condition in (protected, *self.never))
        return {"UPDATE": update, "DELETE": self.only or "TRUE"} | (
            {"INSERT": self.late} if self.late else {}
        )


def install(connection: Any, guards: Iterable[TriggerSpec]) -> None:
    """Drop and create the triggers as currently declared. Raises: NotImplementedError unless SQLite or PostgreSQL."""
    make = {"sqlite": _sqlite, "postgresql": _postgresql}.get(connection.vendor)
    if make is None:
        raise NotImplementedError(f"a database of {connection.vendor}; allowed: sqlite, postgresql")
    with connection.cursor() as cursor:
        for guard in guards:
            for statement in (*removal(connection, guard), *make(guard)):
                cursor.execute(statement)


def triggers_suspended(apps: Any, editor: Any) -> None:
    """Drop all triggers during a migration on SQLite.

    SQLite cannot rebuild a table that is named in a trigger of another table. The triggers are installed again after
    the migration.
    """
    if editor.connection.vendor != "sqlite":
        return
    with editor.connection.cursor() as cursor:
        cursor.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")
        for (name,) in cursor.fetchall():
            cursor.execute(f'DROP TRIGGER "{name}"')


def protect(app: AppConfig) -> None:
    """Install the triggers that the models of `app` declare, after each migration of its tables."""

    def install_guards(sender: AppConfig, using: str, **named: Any) -> None:
        install(connections[using], guards(app))

    post_migrate.connect(install_guards, sender=app, weak=False, dispatch_uid=f"guards of {app.name}")


def guards(app: AppConfig) -> tuple[TriggerSpec, ...]:
    """Return the triggers that the models of `app` declare."""
    return tuple(
        model.append_only.guard(model) for model in app.get_models() if hasattr(model, "append_only")
    )


def removal(connection: Any, guard: TriggerSpec) -> list[str]:
    """Return the SQL statements that drop the triggers of a guard."""
    of = f" ON {guard.table}" if connection.vendor == "postgresql" else ""
    return [f"DROP TRIGGER IF EXISTS {name}{of}" for name in guard.names.values()]


def _sqlite(guard: TriggerSpec) -> list[str]:
    """Return the CREATE statements for SQLite.

    REPLACE deletes rows without DELETE triggers unless PRAGMA recursive_triggers is on, which evaweb.settings does.
    """
    return [
        f"CREATE TRIGGER {guard.names[event]} BEFORE {event} ON {guard.table} WHEN {refused} "
        f"BEGIN SELECT RAISE(ABORT, '{guard.message}'); END"
        for event, refused in guard.refused("IS NOT").items()
    ]


def _postgresql(guard: TriggerSpec) -> list[str]:
    """Return the CREATE statements for PostgreSQL, with one function per trigger.

    A function is needed because a trigger's WHEN condition may not query other rows.
    """
    refused = {**guard.refused("IS DISTINCT FROM"), "TRUNCATE": "TRUE"}
    return [
        statement
        for event, condition in refused.items()
        for statement in (
            f"CREATE OR REPLACE FUNCTION {guard.names[event]}() RETURNS trigger LANGUAGE plpgsql AS $$ "
            f"BEGIN IF {condition} THEN RAISE EXCEPTION USING "
            f"ERRCODE = 'integrity_constraint_violation', MESSAGE = '{guard.message}'; END IF; "
            f"RETURN {'OLD' if event == 'DELETE' else 'NEW'}; END $$",
            f"CREATE TRIGGER {guard.names[event]} BEFORE {event} ON {guard.table} "
            f"FOR EACH {'STATEMENT' if event == 'TRUNCATE' else 'ROW'} EXECUTE FUNCTION {guard.names[event]}()",
        )
    ]
