"""What many tests begin with, played through the services once in each process, and laid down for the others.

Rows and files that an act adds and changes are kept with the state that it began in. Where it is wanted again in the
same state, they are written as they are: a test begins with equal rows whether or not another one came before it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from django.apps import apps
from django.conf import settings
from django.db import connection, transaction

Rows = Mapping[str, Mapping[Any, tuple[Any, ...]]]  # by table and primary key
Files = Mapping[
    str, tuple[int, bytes | None]
]  # mode and content by path in the data folder; None of a folder
_FIRST = "trials_milestoneoutcome"  # to a score that counts the database adds none
_WITH_THE_DATABASE = {"auth_permission", "django_content_type"}
_PEOPLE = {
    "auth_group",
    "auth_user",
    "auth_user_groups",
    "django_session",
}  # may be others where no act made any, but for those that its rows refer to
_acts: dict[Hashable, list[_Act]] = defaultdict(list)


@dataclass(frozen=True, slots=True)
class State:
    """All that a lab keeps."""

    rows: Rows
    files: Files


@dataclass(frozen=True, slots=True)
class _Act:
    before: State
    rows: Rows  # added or changed
    files: Files  # likewise
    people: Rows  # those that `rows` refer to and that were there

    def fits(self, now: State) -> bool:
        """Whether it would begin as it did."""
        ours = now.rows.keys() - (_PEOPLE - self.rows.keys())
        alike = all(now.rows[table] == self.before.rows[table] for table in ours)
        known = all(now.rows[table].items() >= rows.items() for table, rows in self.people.items())
        return alike and known and now.files == self.before.files

    @transaction.atomic
    def lay_down(self) -> None:
        columns = _columns()
        with connection.cursor() as cursor:
            for table in sorted(self.rows, key=lambda name: name != _FIRST):
                names, key = columns[table]
                there = self.before.rows[table].keys() & self.rows[table].keys()
                new = [row for pk, row in self.rows[table].items() if pk not in there]
                quoted = [f'"{name}"' for name in names]
                marks = ", ".join(["%s"] * len(names))
                cursor.executemany(f'INSERT INTO "{table}" ({", ".join(quoted)}) VALUES ({marks})', new)
                changes = ", ".join(f"{name} = %s" for name in quoted)
                for pk in there:
                    cursor.execute(
                        f'UPDATE "{table}" SET {changes} WHERE {quoted[key]} = %s',
                        [*self.rows[table][pk], pk],
                    )
        for path, (mode, content) in self.files.items():
            at = Path(settings.DATA_DIR) / path
            if content is None:
                at.mkdir(parents=True, exist_ok=True)
            else:
                at.parent.mkdir(parents=True, exist_ok=True)
                at.write_bytes(content)
            at.chmod(mode)


def played(name: Hashable, act: Callable[[], object]) -> None:
    """Have the lab as `act` leaves it. It has a name of its own, adds and changes rows and files, and removes none."""
    now = state()
    for kept in _acts[name]:
        if kept.fits(now):
            kept.lay_down()
            return
    act()
    then = state()
    gone = [pk for table, rows in now.rows.items() for pk in rows.keys() - then.rows[table].keys()]
    assert not gone, f"{name} removes rows"
    assert not now.files.keys() - then.files.keys(), f"{name} removes files"
    rows = {
        table: added
        for table, after in then.rows.items()
        if (added := {pk: row for pk, row in after.items() if now.rows[table].get(pk) != row})
    }
    files = {path: told for path, told in then.files.items() if now.files.get(path) != told}
    here = str(settings.DATA_DIR)
    assert here not in repr(rows), f"{name} writes the data folder of its test into a row"
    assert not [path for path, (_, told) in files.items() if told and here.encode() in told], name
    _acts[name].append(_Act(now, rows, files, _people(rows, now)))


def _people(rows: Rows, before: State) -> Rows:
    """What of `before` these rows refer to in tables that may have others where they are laid down."""
    found: dict[str, dict[Any, tuple[Any, ...]]] = defaultdict(dict)
    for model in apps.get_models(include_auto_created=True):
        for at, field in enumerate(model._meta.concrete_fields):
            table = field.related_model._meta.db_table if field.related_model else ""
            if table not in _PEOPLE:
                continue
            for row in rows.get(model._meta.db_table, {}).values():
                if row[at] in before.rows[table]:
                    found[table][row[at]] = before.rows[table][row[at]]
    return found


def state() -> State:
    """As it is now."""
    rows = {}
    with connection.cursor() as cursor:
        for table, (names, key) in _columns().items():
            cursor.execute(
                f'SELECT {", ".join(f"{chr(34)}{name}{chr(34)}" for name in names)} FROM "{table}"'
            )
            rows[table] = {row[key]: tuple(row) for row in cursor.fetchall()}
    folder = Path(settings.DATA_DIR)
    files = {
        str(at.relative_to(folder)): (at.stat().st_mode & 0o7777, at.read_bytes() if at.is_file() else None)
        for at in sorted(folder.rglob("*"))
    }
    return State(rows, files)


def _columns() -> dict[str, tuple[list[str], int]]:
    """Of each table its columns, and which one is the primary key."""
    found = {}
    for model in apps.get_models(include_auto_created=True):
        meta = model._meta
        if meta.managed and not meta.proxy and meta.db_table not in _WITH_THE_DATABASE:
            names = [field.column for field in meta.concrete_fields]
            found[meta.db_table] = names, names.index(meta.pk.column)
    return found
