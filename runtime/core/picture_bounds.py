"""The most pixels of a picture that others give us: a file of some hundred bytes can say that it is gigabytes large."""

from __future__ import annotations

from pathlib import Path
from typing import Any

MOST_PIXELS = 2**24  # such as 4096 x 4096
# FFmpeg's option, looked at before memory is taken: of sizes that decoders have rounded up, so that ours decides.
DECODING = {"max_pixels": str(MOST_PIXELS * 5 // 4)}


class TooLargeError(ValueError):
    """A picture has more pixels than any camera's."""


def require_size(width: int, height: int, whose: str = "its pictures are") -> None:
    """Raise TooLargeError for more than MOST_PIXELS; `whose` begins its sentence."""
    if width * height > MOST_PIXELS:
        raise TooLargeError(
            f"{whose} {width} x {height}; allowed: {MOST_PIXELS} pixels in all, such as 4096 x 4096"
        )


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
