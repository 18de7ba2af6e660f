"""Copy of a recorded video into a dataset: the same encoded images in a seekable file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from runtime.core.errors import RecordingError
from runtime.core.picture_bounds import TooLargeError, open_video

if TYPE_CHECKING:
    import av


@dataclass(frozen=True, slots=True)
class VideoFacts:
    """Properties of a video, as its stream declares them."""

    height: int
    width: int
    codec: str
    pixels: str


def codec_of(video: Path) -> str:
    """Return the codec of a video, e.g. "h264". Raises: RecordingError if it cannot be read."""
    import av

    try:
        with open_video(video) as container:
            return str(container.streams.video[0].codec.canonical_name)
    except (av.FFmpegError, OSError, IndexError, TooLargeError) as error:
        raise RecordingError(f"{video} cannot be read: {error}") from error


def copied_stream(container: av.container.OutputContainer, stream: Any) -> Any:
    """Add a stream to `container` for the encoded images of `stream`, and return it.

    This needs no encoder, so that it also works for AV1.
    """
    return container.add_stream_from_template(stream, opaque=stream.codec.canonical_name != "h264")


def remux(source: Path, target: Path, frames: int, fps: float) -> VideoFacts:
    """Copy the first `frames` encoded images of `source` to `target`: frame k at k / fps, with the file's index in
    front.

    Nothing is encoded anew.

    Raises:
        RecordingError: The source has fewer frames, does not start with a key frame, or has B-frames (its decoding
            order would differ from the order of the rows).
    """
    import av

    rate = Fraction(fps).limit_denominator(10_000)
    copied = 0
    try:
        with (
            open_video(source) as recorded,
            av.open(str(target), "w", format="mp4", options={"movflags": "faststart"}) as container,
        ):
            stream = recorded.streams.video[0]
            copy = copied_stream(container, stream)
            copy.time_base = 1 / rate
            for packet in _in_order(source, recorded, frames):
                packet.pts = packet.dts = copied
                packet.duration = 1
                packet.time_base = 1 / rate
                packet.stream = copy
                container.mux(packet)
                copied += 1
            facts = VideoFacts(stream.height, stream.width, stream.codec.canonical_name, str(stream.pix_fmt))
    except (av.FFmpegError, OSError, IndexError, TooLargeError) as error:
        raise RecordingError(f"{source} cannot be copied after frame {copied}: {error}") from error
    if copied != frames:
        raise RecordingError(f"{source} has {copied} frames for {frames} rows")
    return facts


def cut(source: Path, target: BinaryIO, begin: float, end: float) -> float:
    """Copy the encoded images of `source` from `begin` to `end` [s] to `target`.

    Nothing is encoded anew, so the copy starts with the key frame before `begin`.

    Returns:
        Time in `source` at which the copy starts [s].

    Raises:
        RecordingError: There are no images in this interval, or the source cannot be read.
    """
    import av

    first = None
    try:
        with (
            open_video(source) as recorded,
            av.open(target, "w", format="mp4") as container,
        ):
            stream = recorded.streams.video[0]
            base = stream.time_base
            if base is None:
                raise RecordingError(f"{source} does not say when its pictures are")
            recorded.seek(int(begin / base), stream=stream)
            copy = copied_stream(container, stream)
            copy.time_base = base
            for packet in recorded.demux(stream):
                if packet.pts is None or packet.dts is None:
                    continue
                if packet.pts * base >= end:
                    break
                first = packet.pts if first is None else first
                packet.pts, packet.dts = packet.pts - first, packet.dts - first
                packet.stream = copy
                container.mux(packet)
    except (av.FFmpegError, OSError, IndexError, TooLargeError) as error:
        raise RecordingError(f"{source} cannot be copied from {begin:.2f} s: {error}") from error
    if first is None:
        raise RecordingError(f"{source} has no pictures from {begin:.2f} to {end:.2f} s")
    return float(first * base)


def _in_order(source: Path, recorded: av.container.InputContainer, frames: int) -> Iterator[Any]:
    """Yield the first `frames` packets.

    Raises: RecordingError if the first is no key frame, or decoding order is not presentation order.
    """
    newest: int | None = None
    position = 0
    for packet in recorded.demux(recorded.streams.video[0]):
        if position == frames:
            return
        if packet.pts is None:
            continue
        if newest is None and not packet.is_keyframe:
            raise RecordingError(f"{source} does not start with a key frame")
        if newest is not None and packet.pts <= newest:
            raise RecordingError(
                f"{source} has B-frames at frame {position}: it was not written by our recorder"
            )
        newest = packet.pts
        position += 1
        yield packet
