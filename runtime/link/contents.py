"""List of an episode's files with sizes and SHA-256, which defines the content to send and when it is complete.

Folders with the same list have the same digest. Files whose names start with a dot do not belong to an episode.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID

from runtime.core.errors import CodecError, RecordingError
from runtime.recording.files import disk_error

MANIFEST, OUTCOME = "manifest.json", "outcome.json"
LARGEST_LIST = 1 << 20  # bytes of a packed list
MOST_FILES = 256
LARGEST_EPISODE = 1 << 40  # bytes
_LONGEST_NAME = 255  # bytes
_DIGEST_CHARACTERS = frozenset("0123456789abcdef")
_STEP = 4 << 20  # bytes read between two pauses


@dataclass(frozen=True, slots=True)
class File:
    """File of an episode: name, size [bytes], and SHA-256 in hexadecimal."""

    name: str
    size: int
    sha256: str


@dataclass(frozen=True, slots=True)
class Contents:
    """All files of an episode, sorted by name."""

    files: tuple[File, ...]

    @property
    def size(self) -> int:
        """Size of all files [bytes]."""
        return sum(file.size for file in self.files)

    @property
    def digest(self) -> str:
        """SHA-256 of the packed list, in hexadecimal."""
        return hashlib.sha256(self.packed()).hexdigest()

    def packed(self) -> bytes:
        """Return the list as it is sent: the same bytes for equal lists."""
        rows = [[file.name, file.size, file.sha256] for file in self.files]
        return json.dumps(rows, ensure_ascii=False, separators=(",", ":")).encode()


def unpacked(sent: bytes) -> Contents:
    """Parse and check a list that was sent. Raises: CodecError, naming the entry that an episode cannot have."""
    try:
        rows = json.loads(sent) if len(sent) <= LARGEST_LIST else None
    except (ValueError, RecursionError):
        rows = None
    if not isinstance(rows, list) or not 0 < len(rows) <= MOST_FILES:
        raise CodecError(f"a list of {len(sent)} bytes is none of 1 to {MOST_FILES} files")
    files = tuple(sorted((_file(row) for row in rows), key=lambda file: file.name))
    names = {file.name for file in files}
    if len(names) < len(files):
        raise CodecError("a name is in the list twice")
    if not {MANIFEST, OUTCOME} <= names:
        raise CodecError(f"{MANIFEST} or {OUTCOME} is not in the list: a closed episode has both")
    contents = Contents(files)
    if contents.size > LARGEST_EPISODE:
        raise CodecError(f"it has {contents.size} bytes; allowed: {LARGEST_EPISODE}")
    return contents


def is_episode(uuid: str) -> bool:
    """Return True if `uuid` has the form that recorders write, which makes it safe as a folder name."""
    try:
        return str(UUID(uuid)) == uuid
    except ValueError:
        return False


def contents_of(folder: Path) -> Contents:
    """Return the list of a folder's files; every byte is read. Raises: RecordingError."""
    reading = contents_in_steps(folder)
    while True:
        try:
            next(reading)
        except StopIteration as end:
            contents: Contents = end.value
            return contents


def contents_in_steps(folder: Path) -> Generator[None, None, Contents]:
    """Do the same as `contents_of`, as a generator that pauses after every few megabytes."""
    files = []
    try:
        for path in sorted(folder.iterdir(), key=lambda path: path.name):
            if path.name.startswith("."):
                continue
            digest, size = hashlib.sha256(), 0
            with open(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW), "rb", buffering=0) as file:
                if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                    raise RecordingError(f"{path} is no file: an episode has files alone")
                while data := file.read(_STEP):
                    digest.update(data)
                    size += len(data)
                    yield
            files.append(File(path.name, size, digest.hexdigest()))
    except OSError as error:
        raise disk_error("reading", folder, error) from error
    return Contents(tuple(files))


def _file(row: Any) -> File:
    if not isinstance(row, list) or len(row) != 3:
        raise CodecError(f"{row!r:.80} is no file of a list: expected name, bytes and SHA-256")
    name, size, sha256 = row
    if not _may_name(name):
        raise CodecError(f"{name!r:.80} cannot name a file of an episode")
    if type(size) is not int or not 0 <= size <= LARGEST_EPISODE:
        raise CodecError(f"{name:.80} has {size!r:.40} bytes; allowed: 0 to {LARGEST_EPISODE}")
    if not isinstance(sha256, str) or len(sha256) != 64 or not _DIGEST_CHARACTERS.issuperset(sha256):
        raise CodecError(f"{name:.80} has the SHA-256 {sha256!r:.80}; expected 64 hexadecimal characters")
    return File(name, size, sha256)


def _may_name(name: Any) -> bool:
    """Return True if an episode may have a file `name`: visible, and directly in its folder."""
    if not isinstance(name, str) or not name or name.startswith(".") or "/" in name or "\0" in name:
        return False
    try:
        return len(name.encode()) <= _LONGEST_NAME
    except UnicodeEncodeError:
        return False
