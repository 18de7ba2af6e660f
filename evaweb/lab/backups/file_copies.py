"""Copies of the files of a data folder in use, each listed with its digest."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

from evaweb.core.environment import HUB_KEY
from evaweb.lab.backups.errors import BackupError

SEALS = ("outcome.json", "sealed.json")
_LEFT_OUT = {  # entries of the data folder that are recreated at the next start, or belong to one machine and moment
    "broker",
    "cache",
    "diagnosis",
    "environments",
    HUB_KEY,  # so that no backup suffices to read the tokens in its database
    "jobs",
    "lab.lock",
    "logs",
    "mcap",
    "stops.json",
}
# Copied last: a camera file that was moved to the store during the copy is then in the index, which names it there.
_LAST = "archived"
_LEFT_OUT_ANYWHERE = {
    "bus.key",
    "endpoints",
    "foxglove.token",
    "panel.pin",
    "robot_server.token",
}  # of a station: recreated, see docs/administrator.md
_TRIES = 3
_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class Listed:
    """File of a backup: `path` in the data folder, size [bytes], SHA-256, mode, and modification time [ns].

    A symbolic link has its target as `link`, and no content.
    """

    path: str
    bytes: int
    sha256: str
    mode: int
    mtime_ns: int
    link: str = ""


class FileCopies:
    """Copier of a data folder to `target`; files unchanged since the backup in `before` are hard-linked to their
    copies.

    `changing` are the folders that kept changing during the copy: their files are from different moments.
    """

    def __init__(
        self,
        data: Path,
        target: Path,
        before: tuple[Path, Mapping[str, Listed]] | None,
        without: Iterable[Path],
    ) -> None:
        self._data = data
        self._target = target
        self._before = before
        self._without = {path.absolute() for path in without}
        self.changing: list[str] = []
        self.linked = 0

    def copy(self) -> Iterator[Listed]:
        """Copy everything, and yield the list.

        Raises:
            BackupError: If a file cannot be read, or the disk is full; it names the file.
        """
        for top in sorted(os.scandir(self._data), key=lambda entry: (entry.name == _LAST, entry.name)):
            if top.name in _LEFT_OUT or Path(top.path).absolute() in self._without:
                continue
            if not top.is_dir(follow_symlinks=False):
                yield from self._copied([top.name])
                continue
            inside = sorted(os.scandir(top.path), key=lambda entry: entry.name)
            yield from self._copied(
                [f"{top.name}/{entry.name}" for entry in inside if not entry.is_dir(follow_symlinks=False)]
            )
            for entry in inside:
                if entry.is_dir(follow_symlinks=False):
                    yield from self._steady(f"{top.name}/{entry.name}")

    def _steady(self, unit: str) -> list[Listed]:
        """Copy a folder and return its files.

        The copy is repeated until the folder does not change while it is copied. If the folder changes during every
        try, it is added to `changing`, and the last copy is kept.
        """
        for _ in range(_TRIES):
            names = list(self._walk(unit))
            signs = self._signs(names)
            listed = list(self._copied(names))
            if signs == self._signs(list(self._walk(unit))):
                return listed
        self.changing.append(unit)
        return listed

    def _walk(self, unit: str) -> Iterator[str]:
        """Yield the paths of a folder's files, with the seal of a recording first.

        Once the seal exists, the recording's other files do not change any more.
        """
        paths = []
        for folder, folders, files in os.walk(self._data / unit, onerror=_unless_gone):
            folders[:] = [name for name in folders if name not in _LEFT_OUT_ANYWHERE]
            links = [name for name in folders if os.path.islink(os.path.join(folder, name))]
            at = os.path.relpath(folder, self._data)
            paths += [f"{at}/{name}" for name in [*files, *links] if name not in _LEFT_OUT_ANYWHERE]
        return iter(sorted(paths, key=lambda path: (os.path.basename(path) not in SEALS, path)))

    def _signs(self, names: Iterable[str]) -> list[tuple[str, int, int, int]]:
        signs = []
        for name in names:
            with suppress(FileNotFoundError):
                status = os.lstat(self._data / name)
                signs.append((name, status.st_ino, status.st_size, status.st_mtime_ns))
        return signs

    def _copied(self, names: Iterable[str]) -> Iterator[Listed]:
        for name in names:
            with suppress(
                FileNotFoundError
            ):  # a draft that was renamed, or a stop that was moved to the database
                if (listed := self._copy(name)) is not None:
                    yield listed

    def _copy(self, name: str) -> Listed | None:
        source, target = self._data / name, self._target / name
        status = os.lstat(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)  # of the previous attempt
        if stat.S_ISLNK(status.st_mode):
            link = os.readlink(source)
            os.symlink(link, target)
            return Listed(name, 0, "", 0o777, status.st_mtime_ns, link)
        if not stat.S_ISREG(status.st_mode):
            return None  # a socket or a pipe
        if (same := self._unchanged(name, status)) is not None:
            os.link(self._before[0] / name, target)  # type: ignore[index]
            self.linked += 1
            return same
        return copied(source, target, name)

    def _unchanged(self, name: str, status: os.stat_result) -> Listed | None:
        before = self._before[1].get(name) if self._before else None
        if before is None or (before.bytes, before.mtime_ns, before.mode) != _signature(status):
            return None
        return before


def copied(source: Path, target: Path, name: str) -> Listed:
    """Copy a regular file up to its current size; data appended meanwhile is not included."""
    try:
        with source.open("rb") as read, target.open("xb") as written:
            status = os.fstat(read.fileno())
            digest, size = _through(read, written, status.st_size)
            written.flush()
            os.fsync(written.fileno())
        os.utime(target, ns=(status.st_mtime_ns, status.st_mtime_ns))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise BackupError(
            f"{error.filename or source}: {error.strerror}; nothing was kept of this backup"
        ) from error
    return Listed(name, size, digest, stat.S_IMODE(status.st_mode), status.st_mtime_ns)


def digest_of(path: Path) -> tuple[str, int]:
    """Return SHA-256 and size [bytes] of a file."""
    with path.open("rb") as file:
        return _through(file, None, None)


def write_list(path: Path, files: Iterable[Listed]) -> tuple[int, int]:
    """Write one line per file; return the numbers of files and bytes."""
    count = size = 0
    with path.open("x", encoding="ascii") as lines:
        for listed in files:
            lines.write(json.dumps(asdict(listed)) + "\n")
            count, size = count + 1, size + listed.bytes
        lines.flush()
        os.fsync(lines.fileno())
    return count, size


def read_list(path: Path) -> Iterator[Listed]:
    """Yield the files of a list.

    Raises:
        BackupError: If a line is not valid, or names a path outside the data folder.
    """
    with path.open(encoding="ascii") as lines:
        for number, line in enumerate(lines, 1):
            try:
                listed = Listed(**json.loads(line))
                inside = Path(listed.path)
            except (ValueError, TypeError) as error:
                raise BackupError(f"{path}, line {number}: {error}") from None
            if inside.is_absolute() or ".." in inside.parts:
                raise BackupError(f"{path}, line {number}: {listed.path} is not in a data folder")
            yield listed


def _through(read: BinaryIO, written: BinaryIO | None, most: int | None) -> tuple[str, int]:
    digest, size = hashlib.sha256(), 0
    while block := read.read(_BLOCK if most is None else min(_BLOCK, most - size)):
        digest.update(block)
        if written is not None:
            written.write(block)
        size += len(block)
    return digest.hexdigest(), size


def _signature(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_size, status.st_mtime_ns, stat.S_IMODE(status.st_mode)


def _unless_gone(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError):
        raise BackupError(f"{error.filename}: {error.strerror}; nothing was kept of this backup") from error
