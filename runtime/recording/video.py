"""Fragmented file of coded video that grows while it is written: frame k is the picture of row k."""

from __future__ import annotations

import time
from collections.abc import Iterable
from fractions import Fraction
from typing import Any

import av
import cv2
import numpy as np
from av.video.frame import PictureType
from av.video.reformatter import ColorRange, Colorspace

from runtime.core.types import UInt8
from runtime.recording import codecs
from runtime.recording.codecs import PIXELS
from runtime.recording.encoder_queue import RUN
from runtime.recording.files import AppendFile
from runtime.recording.fragments import frames_in
from runtime.recording.settings import RecordingSettings

# Weights of red, green, blue and 1 for cv2.transform. It has a fast path for three rows; the first is not needed.
_COLOURS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0],
        [-37.797 / 255, -74.203 / 255, 112.0 / 255, 128.0],
        [112.0 / 255, -93.786 / 255, -18.214 / 255, 128.0],
    ],
    np.float32,
)


def to_yuv_planes(picture: UInt8, size: tuple[int, int]) -> av.VideoFrame:
    """Convert a picture RGB uint8 [H, W, 3], scaled to `size` (height and width, both even) if it differs.

    Luma at full size, chroma at half, limited range of ITU-R BT.601. OpenCV needs 0.3 ms where swscale needs 1 ms
    (640x480), because the picture is not copied first. OpenCV's own chroma is that of every second pixel, so chroma is
    computed from the mean of the four pixels that it covers.
    """
    height, width = size
    rgb = np.ascontiguousarray(picture)
    if rgb.shape[:2] != size:
        rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    coded = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420), np.uint8)
    half = cv2.resize(rgb, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    colours = cv2.transform(half, _COLOURS)
    for number, plane in enumerate(coded[height:].reshape(2, height // 2, width // 2), start=1):
        cv2.extractChannel(colours, number, plane)
    # PyAV 18 takes a buffer of other heights for a lower picture; those are copied.
    make_frame = av.VideoFrame.from_numpy_buffer if height % 4 == 0 else av.VideoFrame.from_ndarray
    frame = make_frame(coded, format=PIXELS)
    frame.colorspace, frame.color_range = Colorspace.ITU601, ColorRange.MPEG
    return frame


FRAGMENT_SECONDS = 0.2  # duration that a kill can lose
_FRAGMENTS = "frag_keyframe+empty_moov+default_base_moof"


class FragmentedVideo:
    """Encoder of RGB pictures in sequence, at pts k / fps, without threads of its own.

    Every finished fragment reaches the file in one write, so that after a kill or on a full disk the file still ends
    with a whole fragment. Pictures of another size than `size` are scaled.
    """

    def __init__(
        self, file: AppendFile, size: tuple[int, int], fps: float, settings: RecordingSettings
    ) -> None:
        self.frames = 0  # number of encoded frames
        self.muxed = 0  # number of frames whose packet went to the muxer
        self.muxed_at = 0.0  # time of the newest such packet [s, monotonic]
        self._file = file
        self._muxed = _Muxed()
        self._rate = Fraction(fps).limit_denominator(1001)
        self._size = size
        self._key_next = self._ended = False
        self._picture = to_yuv_planes(np.zeros((*size, 3), dtype=np.uint8), size)
        options = {
            "movflags": _FRAGMENTS,
            "frag_duration": str(int(FRAGMENT_SECONDS * 1e6)),
            "flush_packets": "1",
        }
        self._container = av.open(self._muxed, "w", format="mp4", options=options)
        self._stream = self._open_stream(fps, settings)
        self._container.start_encoding()
        self._store()

    def encode(self, picture: UInt8 | None) -> None:
        """Append one frame: `picture` RGB uint8 [H, W, 3]; None repeats the previous picture (black at first)."""
        if picture is not None:
            self._picture = to_yuv_planes(picture, self._size)
        self._mux(self._code(key=self._key_next))
        self._key_next = False
        self._store()

    def repeat(self, count: int) -> None:
        """Append the previous picture `count` times.

        From RUN repeats on, all but three frames are copies without coding cost. A run of copies alternates between two
        key frames: a decoder would take copies of one frame for a single picture.
        """
        plain = count if count < RUN else count % 2
        for _ in range(plain):
            self.encode(None)
        if plain == count:
            return
        pair = [self._code(key=True), self._code(key=True)]
        for packets in pair:
            self._mux(packets)
        if all(len(packets) == 1 and packets[0].is_keyframe for packets in pair):
            self._copy([packets[0] for packets in pair], count - plain - 2)
        else:  # an encoder that delays frames
            for _ in range(count - plain - 2):
                self._mux(self._code(key=False))
        self._store()

    def close(self) -> None:
        """End the file, whose descriptor stays open; call it again to write bytes that a full disk refused."""
        if not self._ended:
            self._mux(self._stream.encode(None))
            self._container.close()
            self._ended = True
        self._store()

    def _code(self, *, key: bool) -> list[Any]:
        self._picture.pts = self.frames
        self._picture.time_base = 1 / self._rate
        self._picture.pict_type = PictureType.I if key else PictureType.NONE
        packets = list(self._stream.encode(self._picture))
        self.frames += 1
        return packets

    def _copy(self, pair: list[Any], count: int) -> None:
        """Append `count` frames, an even number, that are copies of two encoded key frames in turn.

        The next encoded frame is a key frame, because it must not refer to copies.
        """
        contents = [bytes(packet) for packet in pair]
        for number in range(count):
            packet = av.Packet(contents[number % 2])
            packet.stream = self._stream
            packet.time_base = 1 / self._rate
            packet.pts = packet.dts = self.frames
            packet.duration = 1
            packet.is_keyframe = True
            self._mux([packet])
            self.frames += 1
        self._key_next = True

    def _mux(self, packets: Iterable[Any]) -> None:
        for packet in packets:
            self._container.mux(packet)
            self.muxed += 1
            self.muxed_at = time.monotonic()

    def _open_stream(self, fps: float, settings: RecordingSettings) -> Any:
        gop = settings.chosen_gop(fps)
        options = codecs.options(settings.codec, settings.chosen_preset, settings.chosen_crf, gop)
        stream: Any = self._container.add_stream(settings.codec, rate=self._rate)
        context = stream.codec_context
        codecs.configure_context(context, settings.codec, self._size, self._rate, options, gop)
        context.colorspace, context.color_range = Colorspace.ITU601, ColorRange.MPEG
        return stream

    def _store(self) -> None:
        if self._muxed.bytes:
            self._file.write(self._muxed.bytes, frames_in(self._muxed.bytes))
            self._muxed.bytes = bytearray()


class _Muxed:
    """Output of the muxer since the last write to the file; it has no `seek`, so that the muxer never goes back."""

    def __init__(self) -> None:
        self.bytes = bytearray()

    def write(self, data: bytes) -> int:
        self.bytes += data
        return len(data)
