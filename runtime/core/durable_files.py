"""Files that are on the disk completely, or not at all, when a function returns."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import BinaryIO


class AppendError(OSError):
    """Error that bytes could not be appended; `is_restored`: the file has its previous length again."""

    def __init__(self, error: OSError, is_restored: bool) -> None:
        super().__init__(*error.args)
        self.is_restored = is_restored


def write_durably(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Write a file so that even a power cut leaves either the old or the new content, completely.

    Any number of processes may do so at once; the last one wins. Raises: OSError.
    """
    draft = path.with_name(f".{path.name}.draft")
    with _open_draft(draft, mode) as file:
        try:
            # Content, then name, then folder entry: in this order a power cut leaves the old or the whole new file.
            _fill(file, content)
            os.replace(draft, path)
        except OSError:
            draft.unlink(missing_ok=True)
            raise
    sync_folder(path.parent)


def create_durably(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Write a file that does not exist yet; an existing file stays as it is, even if it appears meanwhile.

    Raises: OSError.
    """
    # A draft of its own, and no lock: nobody waits for a process that stands still.
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with open(draft, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            _fill(file, content)
        with suppress(FileExistsError):
            os.link(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    sync_folder(path.parent)


@contextmanager
def creating_durably(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Yield a file that is at `path`, whole and durable, once the context has ended without an error.

    Until then it is a draft beside; an error removes that, and the next writer reuses one left by a kill. A second
    writer of the same path waits for the first. Raises: OSError; FileExistsError if there is a file at `path`.
    """
    draft = path.with_name(f".{path.name}.draft")
    with _open_draft(draft, mode) as file:
        try:
            file.seek(0)  # of a draft that was reused
            yield file
            file.flush()
            os.fsync(file.fileno())
            _name(draft, path)
        finally:
            draft.unlink(missing_ok=True)
    sync_folder(path.parent)


def _name(draft: Path, path: Path) -> None:
    """Give a draft its name. Raises: OSError; FileExistsError if there is a file of that name."""
    try:
        os.link(draft, path)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        # A file system without hard links, such as that of a memory stick.
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from error
        os.rename(draft, path)


def append_durably(file: FileIO, lines: bytes, sync: Callable[[int], None] | None = None) -> None:
    """Append whole lines to a file opened with "a+b" and no buffer; a torn last line is ended first.

    `sync` is os.fsync by default. A failed append is undone, because a partial line would corrupt the next one.

    Raises: AppendError.
    """
    end = file.seek(0, os.SEEK_END)
    try:
        if end:
            file.seek(end - 1)
            lines = lines if file.read(1) == b"\n" else b"\n" + lines
        while lines:
            lines = lines[file.write(lines) :]
        (sync or os.fsync)(file.fileno())
        if not end:  # the names of a new file, and of its folder
            folder = Path(os.fsdecode(file.name)).parent
            sync_folder(folder)
            sync_folder(folder.parent)
    except OSError as error:
        raise AppendError(error, _truncate(file, end)) from error


def sync_folder(folder: Path) -> None:
    """Make the names in `folder` durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _open_draft(draft: Path, mode: int) -> Iterator[BinaryIO]:
    """Yield the draft file, empty and locked; a draft left by a kill is reused."""
    while True:
        with open(draft, "ab", opener=lambda path, flags: os.open(path, flags, mode)) as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            if _is_at(file, draft):  # else another writer has renamed it between our open and our lock
                file.truncate(0)
                yield file
                return


def _is_at(file: BinaryIO, path: Path) -> bool:
    """Return True if `path` still names the open file `file`. It does not if another writer has replaced the file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def _fill(file: BinaryIO, content: bytes) -> None:
    file.write(content)
    file.flush()
    os.fsync(file.fileno())


def _truncate(file: FileIO, end: int) -> bool:
    try:
        file.truncate(end)
        os.fsync(file.fileno())
    except OSError:
        return False
    return True
