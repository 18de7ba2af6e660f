"""SHA-256 of a file while it grows: of all of it, and of its pieces, so that damaged rows can be named."""

from __future__ import annotations

import hashlib
from typing import Any

FileDigest = dict[
    str, Any
]  # "bytes", "sha256", "pieces": "END ROWS SHA256" each, up to that byte and that row


def rows_per_piece(fps: float) -> int:
    """Of a video: a second of it, so that the list of a long one stays short."""
    return max(1, round(fps))


class Digest:
    """Of a file while it grows. What is added with rows ends a piece once it has `least` of them."""

    def __init__(self, least: int = 1) -> None:
        self._least = least
        self._whole, self._piece = hashlib.sha256(), hashlib.sha256()
        self._bytes = self._rows = self._ended_bytes = self._ended_rows = 0
        self._pieces: list[str] = []

    def add(self, data: bytes | bytearray | memoryview, rows: int = 0) -> None:
        """The next bytes of the file and how many rows or lines are in them; none: a header."""
        if not data:
            return
        self._whole.update(data)
        self._piece.update(data)
        self._bytes += len(data)
        self._rows += rows
        if self._rows == self._ended_rows or self._rows - self._ended_rows >= self._least:
            self._end_piece()

    def to_dict(self) -> FileDigest:
        """As it stands in the outcome."""
        if self._bytes > self._ended_bytes:
            self._end_piece()
        return {"bytes": self._bytes, "sha256": self._whole.hexdigest(), "pieces": list(self._pieces)}

    def _end_piece(self) -> None:
        self._pieces.append(f"{self._bytes} {self._rows} {self._piece.hexdigest()}")
        self._piece = hashlib.sha256()
        self._ended_bytes, self._ended_rows = self._bytes, self._rows
