"""Checks of zip files from outside, before anything of them is used; nothing is ever extracted."""

from __future__ import annotations

import hashlib
import stat
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import IO, cast

from evaweb.core.errors import EvaError
from evaweb.core.printed_names import is_name
from runtime.core.sentences import Pattern

_UNREADABLE = Pattern("results.crates.unreadable", "this is no zip that can be read: {error}")
_TOO_MANY = Pattern("results.crates.too_many", "the crate has {count} files; allowed: at most {most}")
_TOO_LARGE = Pattern(
    "results.crates.too_large",
    "the crate has {count} bytes once unpacked; allowed for its size: at most {most}",
)
_BAD_PATH = Pattern(
    "results.crates.bad_path",
    "the crate has the path {path!r:.200}; allowed: paths below its folder, without .. and backslashes, in one line",
)
_TWICE = Pattern("results.crates.twice", "the crate has {path!r:.200} twice")
_NO_FILE = Pattern(
    "results.crates.no_file",
    "{path:.200} in the crate is a link, a special file or a folder with content; allowed: files and folders",
)
_METHOD = Pattern(
    "results.crates.method",
    "{path:.200} in the crate is encrypted or compressed in an uncommon way; allowed: stored, deflated",
)
_LONG_LIST = Pattern(
    "results.crates.long_list", "the list of files in the crate has {count} bytes; allowed: at most {most}"
)
_LONGER = Pattern("results.crates.longer", "{path:.200} in the crate is not as long as it declares")

MOST_FILES = 20_000
LEAST_BOUND = 100_000_000  # [bytes] that any crate may have once unpacked
MOST_RATIO = 20  # size once unpacked, as a multiple of the size of a larger crate; reports have 3 to 5
_LONGEST = 500  # of a path [characters]
_LARGEST_LIST = (
    12_000_000  # [bytes] of the zip's list of files, each of which takes memory before it can be checked
)
_BLOCK = 1 << 20
_ENCRYPTED = 0x1
_DAMAGED = (
    *(zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, RuntimeError, EOFError, OSError),
    *(ValueError, OverflowError, zlib.error),
)


class _Bounded:
    """File that a zip is read from, in pieces of bounded size: zipfile reads the list of files in one piece."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        if size > _LARGEST_LIST:
            raise EvaError(_LONG_LIST(count=size, most=_LARGEST_LIST))
        return self._file.read(size)


@contextmanager
def opened_zip(file: IO[bytes]) -> Iterator[tuple[zipfile.ZipFile, Mapping[str, zipfile.ZipInfo]]]:
    """Yield a zip with its files by path, after checks of paths, kinds, number and sizes.

    Raises:
        EvaError: If it cannot be read or has anything that is not allowed; also for damage that is found in the block.
    """
    size = file.seek(0, 2)
    file.seek(0)
    try:
        with zipfile.ZipFile(cast("IO[bytes]", _Bounded(file))) as archive:
            yield archive, _checked(archive, size)
    except _DAMAGED as error:
        raise EvaError(_UNREADABLE(error=str(error) or type(error).__name__)) from None


def _checked(archive: zipfile.ZipFile, size: int) -> dict[str, zipfile.ZipInfo]:
    entries = archive.infolist()
    if len(entries) > MOST_FILES:
        raise EvaError(_TOO_MANY(count=len(entries), most=MOST_FILES))
    most, total = max(LEAST_BOUND, MOST_RATIO * size), sum(entry.file_size for entry in entries)
    if total > most:
        raise EvaError(_TOO_LARGE(count=total, most=most))
    files: dict[str, zipfile.ZipInfo] = {}
    for entry in entries:
        # `filename` was cut at a NUL and given other separators; the original has what the sender wrote.
        path = entry.orig_filename
        _check_path(path)
        kind = stat.S_IFMT(entry.external_attr >> 16)
        is_kind = kind in (0, stat.S_IFDIR if entry.is_dir() else stat.S_IFREG)
        if not is_kind or (entry.is_dir() and entry.file_size):
            raise EvaError(_NO_FILE(path=path))
        usual = entry.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        if entry.flag_bits & _ENCRYPTED or not usual:
            raise EvaError(_METHOD(path=path))
        if path in files:
            raise EvaError(_TWICE(path=path))
        if not entry.is_dir():
            files[path] = entry
    return files


def _check_path(path: str) -> None:
    parts = path.removesuffix("/").split("/")
    wrong = any(part in ("", ".", "..") for part in parts) or "\\" in path or ":" in parts[0]
    if wrong or len(path) > _LONGEST or not is_name(path):
        raise EvaError(_BAD_PATH(path=path))


def read_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """Return the content of a file, whose declared size was checked. Raises: EvaError if it is longer."""
    return b"".join(_blocks(archive, entry))


def hash_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> str:
    """Return the SHA-256 of a file without holding it in memory. Raises: EvaError if it is longer than it declares."""
    digest = hashlib.sha256()
    for block in _blocks(archive, entry):
        digest.update(block)
    return digest.hexdigest()


def _blocks(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Iterator[bytes]:
    left = entry.file_size
    with archive.open(entry) as file:
        while block := file.read(_BLOCK):
            left -= len(block)
            if left < 0:
                break
            yield block
    if left:
        raise EvaError(_LONGER(path=entry.filename))
