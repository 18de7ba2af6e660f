"""Extraction of whole JPEG pictures from a byte stream, whatever a camera sends between them."""

from __future__ import annotations

import re
from collections.abc import Iterator

MOST_BYTES = 64 << 20  # more than a noise picture of MOST_PIXELS needs
_HEAD = 2048  # [bytes] from the start of the stream, for messages
_SHORTEST = 4096  # [bytes] outside pictures, more than part headers have
_TYPE = re.compile(rb"content-type:[ \t]*([^\r\n]{1,80})", re.IGNORECASE)
_BEGIN = b"\xff\xd8\xff"
_WITHOUT_LENGTH = frozenset(
    (0x00, 0x01, *range(0xD0, 0xD8))
)  # stuffing, TEM, RSTn: markers without a segment


class Jpegs:
    """JPEG pictures of a stream, found by their markers, each as soon as its last byte has arrived.

    Boundaries, content types and lengths of parts are skipped: cameras write them wrongly or not at all. Thumbnails
    inside a picture are part of it.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self._begun = False
        self._at = 0  # offset in the buffer from which the next marker is searched
        self._head = b""
        self._pictures = 0
        self._beside = 0  # bytes outside pictures since the last whole picture

    def add(self, piece: bytes) -> Iterator[bytes]:
        """Yield the pictures that are completed by `piece`. Raises ValueError if a picture has no end within
        MOST_BYTES.
        """
        self._head += piece[: _HEAD - len(self._head)]
        self._held += piece
        while (picture := self._whole()) is not None:
            self._beside = 0
            self._pictures += 1
            yield picture
        if len(self._held) > MOST_BYTES:
            raise ValueError(f"a picture that it sends has no end within {MOST_BYTES >> 20} MiB")

    @property
    def is_single(self) -> bool:
        """True if the stream so far was exactly one picture, without a part header before it."""
        return self._pictures == 1 and self._head.startswith(_BEGIN)

    @property
    def is_not_mjpeg(self) -> bool:
        """True if more bytes outside pictures have arrived since the last whole picture than headers can have."""
        return self._beside > _SHORTEST

    @property
    def stated(self) -> str:
        """Content type of the first part, "" if it has none."""
        match = _TYPE.search(self._head)
        return "" if match is None else match[1].decode("latin-1").strip()

    def _whole(self) -> bytes | None:
        """Return the next picture; None until its end has arrived."""
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
            if kind == 0xD8:  # start of another picture: this one was cut off
                self._drop(mark)
            elif 0x01 < kind < 0xC0:  # not a JPEG marker
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
        """Drop the bytes before a picture's start at `until`.

        If there is no start (-1), drop all bytes that cannot be the beginning of one.
        """
        self._begun = until >= 0
        dropped = until if self._begun else max(0, len(self._held) - len(_BEGIN) + 1)
        self._beside += dropped
        del self._held[:dropped]
        self._at = 2
