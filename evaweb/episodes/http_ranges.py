"""Byte ranges and validators of HTTP requests (RFC 9110, sections 13 and 14); independent of Django."""

from __future__ import annotations

import re
from dataclasses import dataclass
from email.utils import formatdate, parsedate_to_datetime
from os import stat_result

_RANGE = re.compile(r"bytes=\s*(\d*)-(\d*)\s*", re.IGNORECASE | re.ASCII)
_DIGITS = 18  # enough for any file; int() of a longer header would only cost time


@dataclass(frozen=True, slots=True)
class Validators:
    """Validators that identify one version of a file."""

    etag: str
    last_modified: str

    @classmethod
    def of(cls, stat: stat_result) -> Validators:
        """Return the validators of a file that is never changed in place: a new version has a new inode."""
        tag = f'"{stat.st_ino:x}-{stat.st_mtime_ns:x}-{stat.st_size:x}"'
        return cls(tag, formatdate(stat.st_mtime, usegmt=True))


@dataclass(frozen=True, slots=True)
class Span:
    """Bytes `first` to `last`, inclusive."""

    first: int
    last: int

    @property
    def length(self) -> int:
        return self.last - self.first + 1


class Unsatisfiable(Exception):
    """Error for a well-formed range that starts beyond the end of the file."""


def requested_range(header: str | None, size: int) -> Span | None:
    """Return the single range that `header` requests.

    The result is None without a range, and also for several ranges or a malformed header: then the whole file is the
    answer, which section 14.2 of RFC 9110 permits. Raises: Unsatisfiable.
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
    """Return True if If-Range permits a partial response: same strong tag, or exactly the same date."""
    return if_range is None or if_range in (validators.etag, validators.last_modified)


def not_modified(if_none_match: str | None, if_modified_since: str | None, validators: Validators) -> bool:
    """Return True if the client already has this version of the file.

    If the client sent an entity tag (`if_none_match`), only the tag decides, and the time of modification is ignored.
    """
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
