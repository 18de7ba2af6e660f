"""Which bytes of a file a request asks for (RFC 9110, sections 13 and 14); knows nothing of Django."""

from __future__ import annotations

import re
from dataclasses import dataclass
from email.utils import formatdate, parsedate_to_datetime
from os import stat_result

_RANGE = re.compile(r"bytes=\s*(\d*)-(\d*)\s*", re.IGNORECASE | re.ASCII)
_DIGITS = 18  # enough for any file; int() of a longer header would only cost time


@dataclass(frozen=True, slots=True)
class Validators:
    """Validators of one version of a file, which tell it from another."""

    etag: str
    last_modified: str

    @classmethod
    def of(cls, stat: stat_result) -> Validators:
        """Of a file that is never written in place: a new version is another inode."""
        tag = f'"{stat.st_ino:x}-{stat.st_mtime_ns:x}-{stat.st_size:x}"'
        return cls(tag, formatdate(stat.st_mtime, usegmt=True))


@dataclass(frozen=True, slots=True)
class Span:
    """Bytes `first` to `last`, both included."""

    first: int
    last: int

    @property
    def length(self) -> int:
        return self.last - self.first + 1


class Unsatisfiable(Exception):
    """A well-formed range that begins behind the end of the file."""


def span_asked(header: str | None, size: int) -> Span | None:
    """The one range that `header` asks for; None where it asks for none, for several, or for nonsense.

    Those are answered with the whole file, as section 14.2 lets a server do.
    """
    match = _RANGE.fullmatch(header or "")
    if not match or match[1] == match[2] == "" or max(len(match[1]), len(match[2])) > _DIGITS:
        return None
    if match[1] == "":
        length = min(int(match[2]), size)
        if length == 0:
            raise Unsatisfiable
        return Span(size - length, size - 1)
    first = int(match[1])
    last = min(int(match[2]), size - 1) if match[2] else size - 1
    if match[2] and int(match[2]) < first:
        return None
    if first >= size:
        raise Unsatisfiable
    return Span(first, last)


def range_holds(if_range: str | None, validators: Validators) -> bool:
    """True if If-Range lets the range be answered: same strong tag, or exactly the same date."""
    return if_range is None or if_range in (validators.etag, validators.last_modified)


def not_modified(if_none_match: str | None, if_modified_since: str | None, validators: Validators) -> bool:
    """True if the client has this version already; the tag decides where one was sent."""
    if if_none_match is not None:
        tags = [tag.strip().removeprefix("W/") for tag in if_none_match.split(",")]
        return "*" in tags or validators.etag in tags
    if if_modified_since is None:
        return False
    try:
        since = parsedate_to_datetime(if_modified_since)
        return parsedate_to_datetime(validators.last_modified) <= since
    except (TypeError, ValueError):
        return False
