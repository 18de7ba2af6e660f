"""Turns a recorded video into a dataset's: the same coded pictures in a file that can be sought in."""

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
    """Facts about a video, as its stream says."""

    height: int
    width: int
    codec: str
    pixels: str


def codec_of(video: Path) -> str:
    """The format of its pictures, "h264" for example; raises RecordingError where it cannot be read."""
    import av

    try:
        with open_video(video) as container:
            return str(container.streams.video[0].codec.canonical_name)
    except (av.FFmpegError, OSError, IndexError, TooLargeError) as error:
        raise RecordingError(f"{video} cannot be read: {error}") from error


def copied_stream(container: av.container.OutputContainer, stream: Any) -> Any:
    """A stream of `container` for the coded pictures of `stream`; needs no encoder, as our AV1 decoder is none."""
    return container.add_stream_from_template(stream, opaque=stream.codec.canonical_name != "h264")


def remux(source: Path, target: Path, frames: int, fps: float) -> VideoFacts:
    """Copy the first `frames` coded pictures of `source` to `target`, frame k at k / fps, index at the front.

    Nothing is re-encoded. Raises RecordingError where the source has fewer frames, does not start with a key
    frame, or has B-frames (its coded order would not be the order of the rows).
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
    """Copy the coded pictures of `source` from `begin` to `end` [s] to `target`; where the copy begins [s].

    Nothing is re-encoded: it begins with the key frame before. RecordingError where there are no pictures then.
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
    """The first `frames` packets of the video; raises where decoding order is not presentation order."""
    newest: int | None = None
    taken = 0
    for packet in recorded.demux(recorded.streams.video[0]):
        if taken == frames:
            return
        if packet.pts is None:
            continue
        if newest is None and not packet.is_keyframe:
            raise RecordingError(f"{source} does not start with a key frame")
        if newest is not None and packet.pts <= newest:
            raise RecordingError(
                f"{source} has B-frames at frame {taken}: it was not written by our recorder"
            )
        newest = packet.pts
        taken += 1
        yield packet
