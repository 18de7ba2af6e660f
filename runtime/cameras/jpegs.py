"""Finds whole JPEG pictures in a stream of bytes, whatever a camera writes between them."""

from __future__ import annotations

import re
from collections.abc import Iterator

MOST_BYTES = 64 << 20  # more than a picture of MOST_PIXELS has that is noise
_HEAD = 2048  # bytes from the beginning that are kept for a complaint
_SHORTEST = 4096  # bytes beside pictures that are more than headers of parts
_TYPE = re.compile(rb"content-type:[ \t]*([^\r\n]{1,80})", re.IGNORECASE)
_BEGIN = b"\xff\xd8\xff"
_WITHOUT_LENGTH = frozenset((0x00, 0x01, *range(0xD0, 0xD8)))  # stuffing, TEM, RSTn: no segment follows


class Jpegs:
    """Pictures by their own markers, each as soon as its last byte is there; not by what headers say of it.

    Boundaries, types and lengths of parts are passed over: cameras write them wrongly, or not at all. Thumbnails within
    a picture belong to it.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self._begun = False
        self._at = 0  # where in what is held the next marker of the picture is looked for
        self._head = b""
        self._pictures = 0
        self._beside = 0  # bytes since the last whole picture that were no part of one

    def add(self, piece: bytes) -> Iterator[bytes]:
        """The pictures that end in this piece; raises ValueError where one has no end within MOST_BYTES."""
        self._head += piece[: _HEAD - len(self._head)]
        self._held += piece
        while (picture := self._whole()) is not None:
            self._beside = 0
            self._pictures += 1
            yield picture
        if len(self._held) > MOST_BYTES:
            raise ValueError(f"what it sends as a picture has no end within {MOST_BYTES >> 20} MiB")

    @property
    def is_single(self) -> bool:
        """True if the stream was one picture so far, and no header of a part before it."""
        return self._pictures == 1 and self._head.startswith(_BEGIN)

    @property
    def is_other(self) -> bool:
        """True if more has come since the last whole picture than headers, and it was no picture."""
        return self._beside > _SHORTEST

    @property
    def stated(self) -> str:
        """The type that the first part states, "" where it states none."""
        found = _TYPE.search(self._head)
        return "" if found is None else found[1].decode("latin-1").strip()

    def _whole(self) -> bytes | None:
        """The next picture, None where its end has not come yet."""
        if not self._begun:
            self._drop(self._held.find(_BEGIN))
        while self._begun:
            mark = self._held.find(0xFF, self._at)
            if mark < 0 or mark + 1 == len(self._held):
                self._at = max(self._at, len(self._held) if mark < 0 else mark)
                return None
            kind = self._held[mark + 1]
            if kind == 0xD9:
                picture = bytes(self._held[: mark + 2])
                del self._held[: mark + 2]
                self._begun = False
                return picture
            if kind == 0xD8:  # of another picture: this one was cut off
                self._drop(mark)
            elif 0x01 < kind < 0xC0:  # no marker of JPEG
                self._drop(self._held.find(_BEGIN, mark))
            elif kind == 0xFF or kind in _WITHOUT_LENGTH:
                self._at = mark + (1 if kind == 0xFF else 2)
            elif mark + 4 > len(self._held):
                self._at = mark
                return None
            else:
                self._at = mark + 2 + int.from_bytes(self._held[mark + 2 : mark + 4])
        return None

    def _drop(self, until: int) -> None:
        """Pass over what lies before a picture's beginning; without one (-1) all that cannot be part of it."""
        self._begun = until >= 0
        dropped = until if self._begun else max(0, len(self._held) - len(_BEGIN) + 1)
        self._beside += dropped
        del self._held[:dropped]
        self._at = 2
