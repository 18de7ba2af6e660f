"""Extraction of one episode's video from a file, as the same encoded images if possible."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.picture_bounds import TooLargeError, open_video
from runtime.datasets.entries import Span
from runtime.datasets.remux import copied_stream
from runtime.datasets.video_frames import VideoFrames, VideoSegment

if TYPE_CHECKING:
    import av

TOLERANCE = 1e-4  # LeRobot's tolerance between a row and its image [s]
ENCODING = {"crf": "18", "preset": "veryfast", "g": "2", "bf": "0"}  # x264 options for images encoded anew


class NotCopyableError(RecordingError):
    """Error that the encoded images of an episode cannot be separated from those of other episodes."""


def copy_segment(span: Span, target: Path, frames: int, fps: float) -> None:
    """Copy the `frames` encoded images of `span` to `target`: frame k at k / fps, with the file's index in front.

    A file that already has this form is copied unchanged.

    Raises:
        NotCopyableError: The first image is no key frame, or images of other episodes are stored, in coded
            order, between the images to copy.
        RecordingError: Images are missing, or their times are too far from those of their rows.
    """
    stretch = None if span.start is None else VideoSegment(span.start, frames, fps)
    with VideoFrames(span.path, stretch) as scan:
        times, ticks = scan.times, scan.stamps
    if len(times) < frames:
        raise RecordingError(f"{span.path} has {len(times)} frames for {frames} rows")
    off = np.abs(np.array(times[:frames]) - times[0] - np.arange(frames) / fps).max(initial=0.0)
    if len(times) != frames and off > 0.5 / fps:  # if the counts match, images belong to rows by number
        raise RecordingError(
            f"{span.path}: its pictures are up to {off:.2f} s off the rows, which come at {fps:g} Hz: "
            "make its video anew at that rate"
        )
    if not span.start and _is_ready(span.path, frames, fps):
        shutil.copyfile(span.path, target)
        return
    _copy(span.path, target, ticks[:frames], fps)


def encode_segment(span: Span, target: Path, frames: int, fps: float) -> None:
    """Write the file that `copy_segment` writes, but encode its images anew as H.264, which loses a little quality.

    Raises:
        RecordingError: The images cannot be encoded, or are depth of more than 8 bits.
    """
    import av

    stretch = None if span.start is None else VideoSegment(span.start, frames, fps)
    rate = Fraction(fps).limit_denominator(10_000)
    try:
        with (
            VideoFrames(span.path, stretch) as pictures,
            av.open(str(target), "w", format="mp4", options={"movflags": "faststart"}) as container,
        ):
            if pictures.is_deep:
                raise RecordingError(
                    f"{span.path} has depth of more than 8 bits, of which coding it again would leave 8: "
                    "cut it with the program that made it"
                )
            stream = container.add_stream("libx264", rate=rate, options=dict(ENCODING))
            stream.height, stream.width = pictures.size
            stream.pix_fmt = "yuv420p"
            for number in range(frames):
                frame = av.VideoFrame.from_ndarray(pictures[number], format="rgb24")
                frame.pts, frame.time_base = number, 1 / rate
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    except (av.FFmpegError, OSError, IndexError, ValueError) as error:
        raise RecordingError(f"{span.path} cannot be coded again: {error}") from error


def extra_stream_kinds(path: Path) -> set[str]:
    """Return the types of a video file's streams other than its images."""
    with open_video(path) as container:
        return {stream.type for stream in container.streams} - {"video"}


def _is_ready(path: Path, frames: int, fps: float) -> bool:
    """Return True if the whole file already has the form that `copy_segment` writes."""
    with VideoFrames(path) as whole:
        times = whole.times
    if len(times) != frames or np.abs(np.array(times) - np.arange(frames) / fps).max() > TOLERANCE:
        return False
    with open(path, "rb") as file:
        return _index_first(file)


def _index_first(file: Any) -> bool:
    """Return True if the file's index (box `moov`) comes before its data (`mdat`)."""
    while len(head := file.read(8)) == 8:
        size, kind = int.from_bytes(head[:4], "big"), head[4:]
        if kind in (b"moov", b"mdat"):
            return bool(kind == b"moov")
        if size == 1:
            size = int.from_bytes(file.read(8), "big") - 8
        if size < 8:
            return False
        file.seek(size - 8, 1)
    return False


def _copy(source: Path, target: Path, ticks: list[int], fps: float) -> None:
    import av

    rate = Fraction(fps).limit_denominator(10_000)
    rank = {tick: number for number, tick in enumerate(ticks)}
    try:
        with (
            open_video(source) as recorded,
            av.open(str(target), "w", format="mp4", options={"movflags": "faststart"}) as container,
        ):
            packets = list(_coded(source, recorded, rank))
            # B-frames: decoding times precede presentation by the largest delay in coded order, so that dts <= pts.
            ahead = max(number - rank[packet.pts] for number, packet in enumerate(packets))
            copy = copied_stream(container, recorded.streams.video[0])
            copy.time_base = 1 / rate
            for number, packet in enumerate(packets):
                packet.pts, packet.dts = rank[packet.pts], number - ahead
                packet.duration, packet.time_base = 1, 1 / rate
                packet.stream = copy
                container.mux(packet)
    except (av.FFmpegError, OSError, IndexError, TooLargeError) as error:
        raise RecordingError(f"{source} cannot be copied: {error}") from error


def _coded(source: Path, recorded: av.container.InputContainer, rank: dict[int, int]) -> Iterator[Any]:
    """Yield in coded order the packets of the images in `rank`, which maps time stamps to numbers of images."""
    first = min(rank, key=rank.__getitem__)
    stream = recorded.streams.video[0]
    recorded.seek(first, stream=stream)
    missing = set(rank)
    for packet in recorded.demux(stream):
        if packet.pts is None or packet.is_discard:
            continue
        begun = len(missing) < len(rank)
        if not begun and packet.pts not in missing:
            continue
        if not begun and not (packet.pts == first and packet.is_keyframe):
            raise NotCopyableError(f"{source}: the episode does not begin with a key frame")
        if packet.pts not in missing:
            raise NotCopyableError(f"{source}: pictures of others lie between those of the episode")
        missing.remove(packet.pts)
        yield packet
        if not missing:
            return
    raise RecordingError(f"{source} ends {len(missing)} frames early")
