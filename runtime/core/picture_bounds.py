"""Limits on pixels and scans of untrusted pictures, because a few hundred bytes can declare gigabytes."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

MOST_PIXELS = 2**24  # such as 4096 x 4096
MOST_SCANS = 64  # encoders write about ten; with thumbnails some more
# FFmpeg's option, checked before memory is allocated. Decoders round sizes up, hence the margin: our own check
# decides.
DECODING = {"max_pixels": str(MOST_PIXELS * 5 // 4)}


# Exceptions of Pillow for damaged pictures of any format, in addition to its own (subclasses of OSError).
DAMAGED = (
    *(ArithmeticError, EOFError, LookupError, MemoryError, OSError, SyntaxError, TypeError, ValueError),
    *(struct.error, zlib.error),
)


class TooLargeError(ValueError):
    """Error about a picture that has more pixels or scans than pictures of any camera."""


def require_size(width: int, height: int, whose: str = "its pictures are") -> None:
    """Raise TooLargeError if a picture has more than MOST_PIXELS; `whose` begins the message."""
    if width * height > MOST_PIXELS:
        raise TooLargeError(
            f"{whose} {width} x {height}; allowed: {MOST_PIXELS} pixels in all, such as 4096 x 4096"
        )


def require_scans(coded: bytes, whose: str = "its JPEG has") -> None:
    """Raise TooLargeError if a JPEG has too many scans; `whose` begins the message.

    Each scan takes as long to decode as a whole picture, and may consist of a few bytes only.
    """
    scans = coded.count(b"\xff\xda") if coded.startswith(b"\xff\xd8") else 0  # coded pixels never contain it
    if scans > MOST_SCANS:
        raise TooLargeError(f"{whose} {scans} scans; allowed: {MOST_SCANS}")


def open_video(path: Path | str) -> Any:
    """Open a video for reading with PyAV, with the size of its pictures limited.

    Raises:
        TooLargeError: the container declares larger pictures. Errors of `av.open` are passed on.
    """
    import av

    container = av.open(str(path), options=dict(DECODING), metadata_errors="replace")
    try:
        bound(container)
    except TooLargeError:
        container.close()
        raise
    return container


def bound(container: Any) -> None:
    """Make the decoders of an open container refuse larger pictures; nothing may have been decoded yet.

    Raises:
        TooLargeError: the container already declares larger pictures.
    """
    for stream in container.streams.video:
        if stream.codec_context is None:  # there is no decoder for it
            continue
        require_size(stream.width, stream.height)
        stream.codec_context.options = {**stream.codec_context.options, **DECODING}
