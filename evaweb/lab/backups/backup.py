"""Creating, verifying and restoring backups; each is a folder with a database dump, files and their list."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from django.conf import settings
from django.db import connection
from django.db.migrations.loader import MigrationLoader
from django.db.migrations.recorder import MigrationRecorder
from django.utils import timezone

from evaweb.core.environment import database_files
from evaweb.core.file_checks import RESTORING
from evaweb.lab.backups import databases
from evaweb.lab.backups.errors import BackupError
from evaweb.lab.backups.file_copies import FileCopies, Listed, copied, digest_of, read_list, write_list
from runtime.core.durable_files import sync_folder

FORMAT = 1
ABOUT, LIST, FILES = "backup.json", "files.jsonl", "files"
_PARTIAL = ".partial"
_STARTS_WITH = {"secret_key", "lab_id", "logs"}  # files that every command creates in an empty data folder
Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Backup:
    """Complete backup at `path`, with the contents of its `backup.json`."""

    path: Path
    about: Mapping[str, Any]

    @classmethod
    def at(cls, path: Path) -> Backup:
        """Return the backup at `path`.

        Raises:
            BackupError: If it is not a backup, is incomplete, or has another format.
        """
        try:
            about = json.loads((path / ABOUT).read_text(encoding="utf-8"))
            form = about["format"]
        except FileNotFoundError:
            names = [copy.path.name for copy in backups_in(path)] if path.is_dir() else []
            which = f"; in it are {', '.join(names)}: name one of them" if names else ""
            raise BackupError(f"{path} is no whole backup: it has no {ABOUT}{which}") from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise BackupError(f"{path / ABOUT} cannot be read: {error}") from None
        if form != FORMAT:
            raise BackupError(f"{path} has format {form!r}; this program reads {FORMAT}")
        return cls(path, about)

    @property
    def database(self) -> Path:
        return self.path / self.about["database"]["file"]

    def listed(self) -> Iterator[Listed]:
        """Yield the files of the backup."""
        return read_list(self.path / LIST)


def backups_in(folder: Path) -> list[Backup]:
    """Return the complete backups in a folder, oldest first."""
    names = sorted(path for path in folder.iterdir() if (path / ABOUT).is_file() and path.suffix != _PARTIAL)
    return [Backup.at(path) for path in names]


def make(folder: Path, *, keep: int | None, tell: Tell) -> Backup:
    """Create a backup in `folder`, named by its time; unchanged files are hard links to those of the previous backup.

    The database is copied first, so that every file to which it refers is in the copy.

    Args:
        folder: Folder of all backups, outside the data folder.
        keep: Number of backups to keep, None for all; the oldest are removed.
        tell: Called with a text for each part.

    Raises:
        BackupError: If the backup fails; then none of its files are left.
    """
    folder = folder.expanduser().absolute()
    data = Path(settings.DATA_DIR).absolute()
    if folder.is_relative_to(data):
        raise BackupError(f"{folder} is in the data folder: name a folder elsewhere, best on another disk")
    os.umask(0o077)  # a reader of a backup could act as any logged-in user
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        for left in folder.glob(f"*{_PARTIAL}"):
            shutil.rmtree(left)  # left by an interrupted backup
        before = backups_in(folder)
        now = timezone.now()
        name = now.strftime("%Y-%m-%dT%H%M%S.%fZ")
        target, draft = folder / name, folder / f"{name}{_PARTIAL}"
        draft.mkdir()
        try:
            _write(draft, before[-1] if before else None, now.isoformat(), tell)
            draft.rename(target)
        except OSError as error:
            raise BackupError(
                f"{error.filename or draft}: {error.strerror}; nothing was kept of this backup"
            ) from error
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        sync_folder(folder)
        for old in [*before, Backup.at(target)][: -keep or None] if keep else []:
            tell(f"removing {old.path.name}")
            shutil.rmtree(old.path)
    return Backup.at(target)


def _write(draft: Path, before: Backup | None, now: str, tell: Tell) -> None:
    backend = databases.database()
    tell("database")
    counted = backend.write(draft / backend.file)
    digest, size = digest_of(draft / backend.file)
    tell("files")
    without = (
        database_files(Path(settings.DATABASES["default"]["NAME"])) if backend.engine == "sqlite3" else []
    )
    earlier = (before.path / FILES, {listed.path: listed for listed in before.listed()}) if before else None
    files = FileCopies(Path(settings.DATA_DIR), draft / FILES, earlier, without)
    (draft / FILES).mkdir()
    count, bytes_ = write_list(draft / LIST, files.copy())
    about = {
        "format": FORMAT,
        "made": now,
        "version": version("eva-web"),
        "database": {
            "engine": backend.engine,
            "file": backend.file,
            "bytes": size,
            "sha256": digest,
            "rows": dict(counted),
            "migrations": sorted(map("/".join, MigrationRecorder(connection).applied_migrations())),
        },
        "files": {
            "count": count,
            "bytes": bytes_,
            "linked": files.linked,
            "sha256": digest_of(draft / LIST)[0],
            "changing": files.changing,
        },
    }
    with (draft / ABOUT).open("x", encoding="utf-8") as file:
        json.dump(about, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    sync_folder(draft)


def verify(path: Path, tell: Tell) -> tuple[Backup, list[str]]:
    """Read the complete backup; return it with one sentence per file that differs from what was written."""
    backup = Backup.at(path.expanduser().absolute())
    problems = list(_database_problems(backup))
    if digest_of(backup.path / LIST)[0] != backup.about["files"]["sha256"]:
        return backup, [
            *problems,
            f"{backup.path / LIST} is not as it was written: its files cannot be verified",
        ]
    tell(f"{backup.about['files']['count']:,} files")
    file_problems = (_file_problem(backup.path / FILES / listed.path, listed) for listed in backup.listed())
    return backup, [*problems, *filter(None, file_problems)]


def _database_problems(backup: Backup) -> Iterator[str]:
    about = backup.about["database"]
    if not backup.database.is_file():
        yield f"{backup.database} is not there"
    elif digest_of(backup.database) != (about["sha256"], about["bytes"]):
        yield f"{backup.database} is not as it was written"
    else:
        try:
            backend = databases.of(about["engine"])
            if (rows := backend.read(backup.database)) and rows != about["rows"]:
                yield f"{backup.database} has other numbers of rows than {ABOUT} says"
        except BackupError as error:
            yield str(error)


def _file_problem(path: Path, listed: Listed) -> str:
    try:
        if listed.link or path.is_symlink():
            return (
                ""
                if path.is_symlink() and os.readlink(path) == listed.link
                else f"{path} is not the link that it was"
            )
        return "" if digest_of(path) == (listed.sha256, listed.bytes) else f"{path} is not as it was written"
    except OSError as error:
        return f"{path}: {error.strerror}"


def restore(path: Path, tell: Tell) -> Backup:
    """Restore a backup into the data folder and database of the settings, which must be empty.

    Every file is compared with its digest during the copy, and every table with its number of rows; files are moved
    into the data folder when all are complete.

    Raises:
        BackupError: If it fails. If the restore of the database has begun by then, the folder RESTORING remains, and no
            lab starts while that folder exists.
    """
    backup, backend = Backup.at(path.expanduser().absolute()), databases.database()
    about = backup.about["database"]
    data = Path(settings.DATA_DIR)
    if about["engine"] != backend.engine:
        raise BackupError(
            f"{backup.path} is of {about['engine']}, the settings' database is {backend.engine}: "
            "set DATABASE_URL for that"
        )
    if unknown := sorted(set(about["migrations"]) - _known_migrations()):
        raise BackupError(
            f"{backup.path} was made by version {backup.about['version']}, which has migrations that this one "
            f"({version('eva-web')}) does not know: {', '.join(unknown[:3])}; install that version first"
        )
    if problems := list(_database_problems(backup)):
        raise BackupError("; ".join(problems))
    if digest_of(backup.path / LIST)[0] != backup.about["files"]["sha256"]:
        raise BackupError(f"{backup.path / LIST} is not as it was written")
    os.umask(0o077)
    draft = data / RESTORING
    _require_empty(data, draft, backend)
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir()
    try:
        tell(f"{backup.about['files']['count']:,} files")
        for listed in backup.listed():
            _put_back(backup.path / FILES / listed.path, draft / listed.path, listed)
    except BaseException as error:
        shutil.rmtree(draft, ignore_errors=True)
        if isinstance(error, OSError):
            raise BackupError(f"{error.filename or draft}: {error.strerror}; nothing was put back") from error
        raise
    tell("database")
    backend.restore(backup.database)
    if databases.rows() != about["rows"]:
        raise BackupError("the database has other numbers of rows than the backup: empty it, and try again")
    for top in list(draft.iterdir()):
        _replace(top, data / top.name)
    draft.rmdir()
    sync_folder(data)
    return backup


def _put_back(source: Path, target: Path, listed: Listed) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if listed.link:
        os.symlink(listed.link, target)
        return
    try:
        now = copied(source, target, listed.path)
    except FileNotFoundError:
        raise BackupError(f"{source} is not there; nothing was put back") from None
    if (now.sha256, now.bytes) != (listed.sha256, listed.bytes):
        raise BackupError(f"{source} is not as it was written; nothing was put back")
    target.chmod(listed.mode)
    os.utime(target, ns=(listed.mtime_ns, listed.mtime_ns))


def _replace(source: Path, target: Path) -> None:
    if target.is_dir() and not target.is_symlink():
        shutil.rmtree(target)  # logs of this command
    source.rename(target)


def _require_empty(data: Path, draft: Path, backend: databases.Database) -> None:
    backend.require_empty()
    allowed = {draft.name, *_STARTS_WITH}
    if backend.engine == "sqlite3":
        allowed |= {path.name for path in database_files(Path(settings.DATABASES["default"]["NAME"]))}
    if names := sorted(path.name for path in data.iterdir() if path.name not in allowed):
        raise BackupError(
            f"{data} has {', '.join(names[:5])}: a backup is put back into an empty data folder"
        )


def _known_migrations() -> set[str]:
    return set(map("/".join, MigrationLoader(None).disk_migrations))


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    with (folder / ".lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BackupError(f"another backup is being made in {folder}") from None
        yield
