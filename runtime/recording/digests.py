"""SHA-256 of a growing file and of its pieces, by which damaged rows can be located."""

from __future__ import annotations

import hashlib
from typing import Any

FileDigest = dict[str, Any]  # "bytes", "sha256", "pieces": each "END ROWS SHA256", up to that byte and row


def rows_per_piece(fps: float) -> int:
    """Return the number of rows per piece of a video: those of one second.

    This keeps the list of pieces of a long video short.
    """
    return max(1, round(fps))


class Digest:
    """Digest of a growing file and of its pieces. A piece ends when it has at least `least` rows."""

    def __init__(self, least: int = 1) -> None:
        self._least = least
        self._whole, self._piece = hashlib.sha256(), hashlib.sha256()
        self._bytes = self._rows = self._ended_bytes = self._ended_rows = 0
        self._pieces: list[str] = []

    def add(self, data: bytes | bytearray | memoryview, rows: int = 0) -> None:
        """Add the next bytes of the file, which contain `rows` rows or lines (0 for a header)."""
        if not data:
            return
        self._whole.update(data)
        self._piece.update(data)
        self._bytes += len(data)
        self._rows += rows
        if self._rows == self._ended_rows or self._rows - self._ended_rows >= self._least:
            self._end_piece()

    def to_dict(self) -> FileDigest:
        """Return the digest in the form that the outcome contains."""
        if self._bytes > self._ended_bytes:
            self._end_piece()
        return {"bytes": self._bytes, "sha256": self._whole.hexdigest(), "pieces": list(self._pieces)}

    def _end_piece(self) -> None:
        self._pieces.append(f"{self._bytes} {self._rows} {self._piece.hexdigest()}")
        self._piece = hashlib.sha256()
        self._ended_bytes, self._ended_rows = self._bytes, self._rows
