"""Coded pictures of a recorded camera, one per row: packets of H.264 as Annex B, or JPEG."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import simplejpeg

from runtime.core.errors import RecordingError
from runtime.core.picture_bounds import TooLargeError, open_video
from runtime.datasets.video_frames import VideoFrames
from runtime.recording import codecs

_START = b"\x00\x00\x00\x01"
_SPS = 7  # type of a NAL unit: H.264, table 7-1
_QUALITY = 90  # of JPEG
_PRESET, _CRF = "veryfast", 18  # of pictures that are coded again


def why_not_copied(video: Path, frames: int) -> str:
    """Return why the first `frames` packets cannot be copied as they are; "" if they can.

    Raises RecordingError if the video cannot be read or has fewer frames.
    """
    import av

    count, newest, reason = 0, None, ""
    try:
        with open_video(video) as container:
            stream = container.streams.video[0]
            codec = str(stream.codec.canonical_name)
            if codec != "h264":
                reason = f"its codec is {codec}"
            elif stream.codec_context.has_b_frames:
                reason = "it has B frames"
            for packet in _packets(container, stream):
                if count == frames:
                    break
                if newest is not None and packet.pts <= newest:
                    reason = reason or "it has B frames"
                if count == 0 and not packet.is_keyframe:
                    reason = reason or "it does not begin with a key frame"
                newest, count = packet.pts, count + 1
    except (av.FFmpegError, OSError, IndexError, TooLargeError) as error:
        raise RecordingError(f"{video} cannot be read after frame {count}: {error}") from error
    if count < frames:
        raise RecordingError(f"{video} has {count} frames for {frames} rows")
    return reason


def copied_packets(video: Path, frames: int) -> Iterator[bytes]:
    """Yield the first `frames` packets as they were coded, as Annex B, with SPS and PPS in every key frame.

    Raises RecordingError if the video cannot be read.
    """
    import av
    from av.bitstream import BitStreamFilterContext

    count = 0
    try:
        with open_video(video) as container:
            stream = container.streams.video[0]
            sets = _parameter_sets(stream.codec_context.extradata or b"")
            convert = BitStreamFilterContext("h264_mp4toannexb", in_stream=stream)
            for packet in _packets(container, stream):
                if count == frames:
                    return
                is_key = packet.is_keyframe
                data = b"".join(bytes(part) for part in convert.filter(packet))
                if not data:
                    raise RecordingError(f"{video}: frame {count} has no packet of its own")
                yield sets + data if is_key and _SPS not in nal_types(data) else data
                count += 1
    except (av.FFmpegError, OSError, IndexError, TooLargeError) as error:
        raise RecordingError(f"{video} cannot be read after frame {count}: {error}") from error


def coded_again(video: Path, frames: int, fps: float) -> Iterator[bytes]:
    """Yield the first `frames` pictures coded anew as H.264 without B frames, as Annex B.

    Raises RecordingError if the video cannot be decoded.
    """
    import av
    from av.video.frame import PictureType

    rate = Fraction(fps).limit_denominator(1001)
    coder: Any = av.CodecContext.create("libx264", "w")
    coder.pix_fmt, coder.time_base, coder.framerate = codecs.PIXELS, 1 / rate, rate
    coder.options = codecs.options("libx264", _PRESET, _CRF, max(1, round(fps)))
    count = 0
    try:
        with open_video(video) as container:
            stream = container.streams.video[0]
            coder.width, coder.height = stream.width, stream.height
            for frame in container.decode(stream):
                if count == frames:
                    break
                picture = frame.reformat(stream.width, stream.height, codecs.PIXELS)
                picture.pts, picture.time_base = count, 1 / rate
                picture.pict_type = PictureType.NONE
                (packet,) = coder.encode(picture)  # options of the recorder: an encoder without delay
                yield bytes(packet)
                count += 1
    except (av.FFmpegError, OSError, IndexError, ValueError) as error:
        raise RecordingError(f"{video} cannot be coded again after frame {count}: {error}") from error
    if count < frames:
        raise RecordingError(f"{video} has {count} frames for {frames} rows")


def jpegs(video: Path, frames: int) -> Iterator[bytes]:
    """Yield the first `frames` pictures as JPEG. Raises RecordingError if the video cannot be decoded."""
    with VideoFrames(video) as pictures:
        if len(pictures) < frames:
            raise RecordingError(f"{video} has {len(pictures)} frames for {frames} rows")
        for number in range(frames):
            coded: bytes = simplejpeg.encode_jpeg(pictures[number], quality=_QUALITY)
            yield coded


def nal_types(data: bytes) -> tuple[int, ...]:
    """Return the types of the NAL units in a packet of Annex B."""
    return tuple(unit[0] & 31 for unit in data.split(b"\x00\x00\x01")[1:] if unit)


def _packets(container: Any, stream: Any) -> Iterator[Any]:
    return (packet for packet in container.demux(stream) if packet.pts is not None)


def _parameter_sets(configuration: bytes) -> bytes:
    """Return SPS and PPS of an AVCDecoderConfigurationRecord (ISO/IEC 14496-15, 5.3.3.1) as Annex B."""
    if not configuration.startswith(b"\x01"):  # already Annex B, or nothing
        return configuration
    sets, at = b"", 5
    for mask in (31, 255):
        count, at = configuration[at] & mask, at + 1
        for _ in range(count):
            (size,) = struct.unpack_from(">H", configuration, at)
            sets += _START + configuration[at + 2 : at + 2 + size]
            at += 2 + size
    return sets
