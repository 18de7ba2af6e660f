"""Reading of fragmented MP4 files whose end may be torn: their whole fragments, and the number of decodable frames."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import av

from runtime.core.errors import RecordingError
from runtime.core.picture_bounds import TooLargeError, open_video

_HEADER = struct.Struct(">I4s")
_LONG = struct.Struct(">Q")


def whole_bytes(path: Path) -> int:
    """Return the number of bytes up to the end of the last whole fragment (moof and its mdat).

    0 if the header is torn. Boxes as in ISO/IEC 14496-12, section 4.2.
    """
    with open(path, "rb") as file:
        total = file.seek(0, 2)
        end = position = 0
        before = b""
        while (box := _box(file, position, total)) is not None:
            kind, position = box
            if kind in (b"moov", b"mfra") or (kind == b"mdat" and before == b"moof"):
                end = position
            before = kind
    return end


def fragments(path: Path) -> Iterator[tuple[bytes, int]]:
    """Yield the parts of the file, each with its number of frames.

    The parts are the header, the fragments, and the rest after the last whole fragment.
    """
    with open(path, "rb") as file:
        total = file.seek(0, 2)
        begin = end = 0
        while (box := _box(file, end, total)) is not None:
            kind, end = box
            if kind in (b"moov", b"mdat"):
                yield _part(file, begin, end)
                begin = end
        yield _part(file, begin, total)


def _part(file: BinaryIO, begin: int, end: int) -> tuple[bytes, int]:
    file.seek(begin)
    data = file.read(end - begin)
    return data, frames_in(data)


def frames_in(data: bytes | bytearray) -> int:
    """Return the number of frames in the whole fragments of `data`.

    The number comes from the run boxes of the fragments (ISO/IEC 14496-12, section 8.8.8).
    """
    return _samples(io.BytesIO(data), 0, len(data))


def _samples(file: BinaryIO, position: int, total: int) -> int:
    frames = 0
    while (box := _box(file, position, total)) is not None:
        kind, end = box
        if kind in (b"moof", b"traf"):
            frames += _samples(file, position + _HEADER.size, end)
        elif kind == b"trun":
            file.seek(position + _HEADER.size + 4)
            frames += int.from_bytes(file.read(4), "big")
        position = end
    return frames


def count_frames(path: Path) -> int:
    """Return the number of frames that decode from the start of the file to its possibly torn end; 0 if there are none.

    All packets are counted. Only the last two groups of pictures can have suffered from a kill or a power cut, so only
    these are decoded.
    """
    try:
        if whole_bytes(path) == 0:
            return 0
        with open_video(path) as container:
            return _count(container)
    except (av.FFmpegError, TooLargeError):
        return 0
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error


def _count(container: Any) -> int:
    stream = next(iter(container.streams.video), None)
    if stream is None or stream.codec_context is None:  # a header with lost tables
        return 0
    before = 0
    groups: list[list[Any]] = []
    for packet in _packets(container, stream):
        if packet.is_keyframe:
            groups.append([])
            if len(groups) > 2:
                before += len(groups.pop(0))
        if groups:
            groups[-1].append(packet)
    return before + _decodable(stream.codec_context, [packet for group in groups for packet in group])


def _packets(container: Any, stream: Any) -> Any:
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except (StopIteration, av.FFmpegError):
            return
        if packet.size == 0 or packet.is_corrupt:
            return
        yield packet


def _decodable(context: Any, packets: list[Any]) -> int:
    frames = 0
    try:
        for packet in packets:
            frames += sum(not frame.is_corrupt for frame in context.decode(packet))
        frames += sum(not frame.is_corrupt for frame in context.decode(None))
    except av.FFmpegError:
        return frames
    return frames


def _box(file: BinaryIO, position: int, total: int) -> tuple[bytes, int] | None:
    """Return kind and end of the box at `position`; None if it is incomplete."""
    file.seek(position)
    header = file.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return None
    size, kind = _HEADER.unpack(header)
    if size == 1:
        long = file.read(_LONG.size)
        if len(long) < _LONG.size:
            return None
        size = _LONG.unpack(long)[0]
    if size < _HEADER.size or position + size > total:
        return None
    return kind, position + size
