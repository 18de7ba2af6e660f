"""Rows that the database itself refuses to change or remove, whatever program asks it to.

A model says so by `append_only = AppendOnly(...)`. Triggers are installed after every migration, because SQLite loses a
table's when a migration rebuilds it.
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
    """What of a model's rows is never changed: all but `except_columns`, or `columns` alone; nor is a row removed.

    `message` is what whoever tries is told. `only`: SQL about OLD, which rows that holds for; all where it is empty.
    `moves`: of these columns, what may follow each value; from one that is not named everything may. `never`: SQL about
    OLD and NEW that no change of any row makes true. `late`: SQL about NEW, which rows are never added.
    """

    message: str
    columns: tuple[str, ...] = ()
    except_columns: tuple[str, ...] = ()
    condition: str = ""
    allowed_changes: Mapping[str, Mapping[str, Sequence[str]]] = field(default_factory=dict)
    never: tuple[str, ...] = ()
    forbidden_inserts: str = ""

    def guard(self, model: type[Model]) -> TriggerSpec:
        """The same as the database knows it."""
        for name in (*self.columns, *self.except_columns, *self.allowed_changes):
            model._meta.get_field(name)  # or FieldDoesNotExist
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
    """What of `table` stays: the values of `columns`, and the row. `message` is what whoever tries is told."""

    table: str
    columns: tuple[str, ...]
    message: str
    only: str = ""  # SQL about OLD: which rows are kept; all where it is empty
    never: tuple[str, ...] = ()  # SQL about OLD and NEW: what no change may be
    late: str = ""  # SQL about NEW: which rows are not added

    @property
    def names(self) -> Mapping[str, str]:
        """Its triggers, by what they are against."""
        names = {
            "UPDATE": "kept",
            "DELETE": "never_removed",
            "INSERT": "complete",
            "TRUNCATE": "never_emptied",
        }
        return {event: f"{self.table}_{name}" for event, name in names.items()}

    def refused(self, different: str) -> Mapping[str, str]:
        """SQL about OLD and NEW, by event: what is refused. `different`: the operator that also compares NULL."""
        changed = " OR ".join(f'OLD."{column}" {different} NEW."{column}"' for column in self.columns)
        kept = f"({self.only or 'TRUE'}) AND ({changed})"
        update = " OR ".join(f"({each})" for each in (kept, *self.never))
        return {"UPDATE": update, "DELETE": self.only or "TRUE"} | (
            {"INSERT": self.late} if self.late else {}
        )


def install(connection: Any, guards: Iterable[TriggerSpec]) -> None:
    """Make the triggers anew, as they are declared now; other databases than SQLite and PostgreSQL are refused."""
    make = {"sqlite": _sqlite, "postgresql": _postgresql}.get(connection.vendor)
    if make is None:
        raise NotImplementedError(f"a database of {connection.vendor}; allowed: sqlite, postgresql")
    with connection.cursor() as cursor:
        for guard in guards:
            for statement in (*removal(connection, guard), *make(guard)):
                cursor.execute(statement)


def triggers_suspended(apps: Any, editor: Any) -> None:
    """For a migration: SQLite rebuilds no table that a trigger of another one names. They come back once it is done."""
    if editor.connection.vendor != "sqlite":
        return
    with editor.connection.cursor() as cursor:
        cursor.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")
        for (name,) in cursor.fetchall():
            cursor.execute(f'DROP TRIGGER "{name}"')


def protect(app: AppConfig) -> None:
    """Have what the models of `app` declare installed whenever its tables were migrated."""

    def install_guards(sender: AppConfig, using: str, **named: Any) -> None:
        install(connections[using], guards(app))

    post_migrate.connect(install_guards, sender=app, weak=False, dispatch_uid=f"guards of {app.name}")


def guards(app: AppConfig) -> tuple[TriggerSpec, ...]:
    """What the models of `app` declare."""
    return tuple(
        model.append_only.guard(model) for model in app.get_models() if hasattr(model, "append_only")
    )


def removal(connection: Any, guard: TriggerSpec) -> list[str]:
    """What takes the triggers of a guard away."""
    of = f" ON {guard.table}" if connection.vendor == "postgresql" else ""
    return [f"DROP TRIGGER IF EXISTS {name}{of}" for name in guard.names.values()]


def _sqlite(guard: TriggerSpec) -> list[str]:
    """REPLACE removes a row too: settings has recursive_triggers, with which that is refused."""
    return [
        f"CREATE TRIGGER {guard.names[event]} BEFORE {event} ON {guard.table} WHEN {refused} "
        f"BEGIN SELECT RAISE(ABORT, '{guard.message}'); END"
        for event, refused in guard.refused("IS NOT").items()
    ]


def _postgresql(guard: TriggerSpec) -> list[str]:
    """A function for each trigger: the conditions of triggers themselves know no other rows."""
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
