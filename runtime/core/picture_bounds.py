"""The most pixels and scans of pictures that others give us: some hundred bytes can say that they are gigabytes."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

MOST_PIXELS = 2**24  # such as 4096 x 4096
MOST_SCANS = 64  # encoders write about ten, and their thumbnails some more
# FFmpeg's option, looked at before memory is taken: of sizes that decoders have rounded up, so that ours decides.
DECODING = {"max_pixels": str(MOST_PIXELS * 5 // 4)}


# What Pillow raises of a picture that is damaged, whichever its format, beside its own errors (which are OSError).
DAMAGED = (
    *(ArithmeticError, EOFError, LookupError, MemoryError, OSError, SyntaxError, TypeError, ValueError),
    *(struct.error, zlib.error),
)


class TooLargeError(ValueError):
    """A picture has more pixels, or more scans, than any camera's."""


def require_size(width: int, height: int, whose: str = "its pictures are") -> None:
    """Raise TooLargeError for more than MOST_PIXELS; `whose` begins its sentence."""
    if width * height > MOST_PIXELS:
        raise TooLargeError(
            f"{whose} {width} x {height}; allowed: {MOST_PIXELS} pixels in all, such as 4096 x 4096"
        )


def require_scans(coded: bytes, whose: str = "its JPEG has") -> None:
    """Raise TooLargeError for a JPEG of so many scans that some bytes each cost a whole picture."""
    scans = coded.count(b"\xff\xda") if coded.startswith(b"\xff\xd8") else 0  # coded pixels never hold it
    if scans > MOST_SCANS:
        raise TooLargeError(f"{whose} {scans} scans; allowed: {MOST_SCANS}")


def open_video(path: Path | str) -> Any:
    """PyAV's container of a video that is read, bounded; raises what `av.open` raises, and TooLargeError."""
    import av

    container = av.open(str(path), options=dict(DECODING), metadata_errors="replace")
    try:
        bound(container)
    except TooLargeError:
        container.close()
        raise
    return container


def bound(container: Any) -> None:
    """Let the decoders of an open container, which have decoded nothing yet, refuse larger pictures.

    TooLargeError where the container says already that they are.
    """
    for stream in container.streams.video:
        if stream.codec_context is None:  # nobody can decode it
            continue
        require_size(stream.width, stream.height)
        stream.codec_context.options = {**stream.codec_context.options, **DECODING}
