"""Dump of the lab's database to one file, by SQLite's backup or pg_dump, with the number of rows of each table."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from django.conf import settings
from django.db import connection, transaction

from evaweb.core.environment import database_files
from evaweb.lab.backups.errors import BackupError

Rows = Mapping[str, int]


class Database(Protocol):
    """Interface of a kind of database: dump, check and restore."""

    engine: str
    file: str  # name in a backup

    def write(self, path: Path) -> Rows:
        """Write a consistent dump; return the number of rows of each table."""

    def read(self, path: Path) -> Rows:
        """Check a dump, and return the number of rows of each table.

        The result is {} if the rows cannot be counted without a database server, as for PostgreSQL.
        """

    def require_empty(self) -> None:
        """Raise BackupError if the database has a table."""

    def restore(self, path: Path) -> None:
        """Restore a dump, completely or not at all."""


def database() -> Database:
    """Return the database of the settings.

    Raises:
        BackupError: If its kind is not supported.
    """
    return of("sqlite3" if connection.vendor == "sqlite" else connection.vendor)


def of(engine: str) -> Database:
    """Return the database of a kind: sqlite3 or postgresql.

    Raises:
        BackupError: If the kind is not supported.
    """
    for backend in (_SQLite(), _PostgreSQL()):
        if backend.engine == engine:
            return backend
    raise BackupError(f"a database of {engine} cannot be backed up; allowed: sqlite3, postgresql")


def rows() -> Rows:
    """Return the number of rows of each table of the lab's database."""
    quote = connection.ops.quote_name
    with connection.cursor() as cursor:
        names = connection.introspection.table_names(cursor)
        return _counted(cursor, {name: quote(name) for name in names})


def _counted(cursor: object, names: Mapping[str, str]) -> Rows:
    counts = {}
    for name, quoted in sorted(names.items()):
        cursor.execute(f"SELECT count(*) FROM {quoted}")  # type: ignore[attr-defined]
        counts[name] = int(cursor.fetchone()[0])  # type: ignore[attr-defined]
    return counts


@dataclass(frozen=True, slots=True)
class _SQLite:
    engine: str = "sqlite3"
    file: str = "database.sqlite3"

    @property
    def _path(self) -> Path:
        return Path(settings.DATABASES["default"]["NAME"])

    def write(self, path: Path) -> Rows:
        if not self._path.is_file() or not self._path.stat().st_size:
            raise BackupError(
                f"{self._path} is no database of a lab: set EVA_DATA_DIR to the lab's data folder"
            )
        path.touch(mode=0o600)
        with (
            closing(sqlite3.connect(f"{self._path.as_uri()}?mode=ro", uri=True)) as source,
            closing(sqlite3.connect(path)) as copy,
        ):
            source.backup(copy)  # all pages in one read transaction: writers continue in the write-ahead log
            copy.execute("PRAGMA journal_mode=DELETE")  # a single file
        _sync(path)
        return self.read(path)

    def read(self, path: Path) -> Rows:
        try:
            with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as copy:
                messages = [row[0] for row in copy.execute("PRAGMA integrity_check")]
                if messages != ["ok"]:
                    raise BackupError(f"{path}: {'; '.join(messages[:5])}")
                if broken := copy.execute("PRAGMA foreign_key_check").fetchone():
                    raise BackupError(
                        f"{path}: row {broken[1]} of {broken[0]} refers to a row of {broken[2]} that is not there"
                    )
                names = copy.execute(
                    "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite\\_%' ESCAPE '\\'"
                )
                return _counted(copy.cursor(), {name: f'"{name}"' for (name,) in names})
        except sqlite3.DatabaseError as error:
            raise BackupError(f"{path}: {error}") from None

    def require_empty(self) -> None:
        if self._path.exists() and rows():
            raise BackupError(f"{self._path} has tables: a backup is put back into an empty lab")

    def restore(self, path: Path) -> None:
        connection.close()
        for old in database_files(self._path):
            old.unlink()
        draft = self._path.with_name(f".{self._path.name}.restored")
        shutil.copyfile(path, draft)
        draft.chmod(0o600)
        _sync(draft)
        draft.rename(self._path)


@dataclass(frozen=True, slots=True)
class _PostgreSQL:
    engine: str = "postgresql"
    file: str = "database.dump"

    def write(self, path: Path) -> Rows:
        with transaction.atomic(), connection.cursor() as cursor:
            cursor.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
            cursor.execute("SELECT pg_export_snapshot()")
            moment = cursor.fetchone()[0]
            self._run(
                "pg_dump",
                ["--format=custom", "--no-owner", "--no-acl", f"--snapshot={moment}", f"--file={path}"],
            )
            counted = rows()  # in the same transaction as the snapshot
        _sync(path)
        return counted

    def read(self, path: Path) -> Rows:
        _call(["pg_restore", "--list", str(path)], {})
        return {}

    def require_empty(self) -> None:
        if tables := rows():
            raise BackupError(
                f"the database has tables ({', '.join(sorted(tables)[:3])}): a backup is put back into an empty one"
            )

    def restore(self, path: Path) -> None:
        self._run(
            "pg_restore",
            ["--exit-on-error", "--single-transaction", "--no-owner", "--no-acl"],
            [str(path)],
            named=True,
        )

    def _run(
        self, program: str, options: Iterable[str], files: Iterable[str] = (), *, named: bool = False
    ) -> None:
        """Run a program with server and user of the settings; the password is in the environment, because
        `ps` shows arguments.
        """
        (_, *where), environment = connection.client.settings_to_cmd_args_env(connection.settings_dict, [])
        *server, name = where
        _call([program, *options, *server, *(["--dbname"] if named else []), name, *files], environment or {})


def _call(command: list[str], environment: Mapping[str, str]) -> None:
    try:
        completed = subprocess.run(
            command, env=os.environ | dict(environment), capture_output=True, text=True
        )
    except FileNotFoundError:
        raise BackupError(
            f"{command[0]} is not installed here: it comes with PostgreSQL's client programs"
        ) from None
    if completed.returncode:
        raise BackupError(
            f"{command[0]}: {completed.stderr.strip()[-2000:] or f'exit code {completed.returncode}'}"
        )


def _sync(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
