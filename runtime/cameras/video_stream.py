"""Open connection to one camera, which returns decoded RGB pictures in sequence, each within a deadline."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.cameras.base import Address, CameraError
from runtime.cameras.jpegs import Jpegs
from runtime.cameras.open_errors import ended, explain_open_error, undecodable_text
from runtime.core.picture_bounds import DECODING, TooLargeError, bound, require_size
from runtime.core.types import UInt8

_THERE_S = 0.003  # [s]; a packet that arrives faster was already waiting
_AT_ONCE = 2  # packets in a row that may arrive together
_SHOWN = 100  # of a continuous backlog, every hundredth packet is used
_PARTS = "mpjpeg"  # FFmpeg's name; its own reader refuses streams with incorrect part headers


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """Decoded picture uint8 [H, W, 3] RGB, with its time in the stream [s] if the stream has time stamps, else None."""

    picture: UInt8
    stamp: float | None


class Backlog:
    """Detector of a reader that is slower than its stream: it receives many packets in a row without waiting."""

    def __init__(self) -> None:
        self._waiting = 0  # packets in a row that arrived without waiting

    def should_skip(self, waited: float) -> bool:
        """Return True if a packet can be skipped because newer ones are queued; the reader waited for it `waited` [s].

        A packet that was available without waiting can be skipped, with two exceptions. The first two such packets in a
        row are used, because two may arrive together. Every hundredth is used, so that a stream that never pauses still
        yields pictures.
        """
        self._waiting = self._waiting + 1 if waited < _THERE_S else 0
        return self._waiting > _AT_ONCE and self._waiting % _SHOWN != 0


class VideoStream:
    """Stream opened with PyAV, for use by one thread. Waiting happens in FFmpeg, without the interpreter lock.

    FFmpeg enforces the deadlines while it waits for data (PyAV's `timeout`). This class also raises an error if data
    arrive but yield no picture for too long. FFmpeg only fetches the bytes of JPEG pictures in multipart streams; this
    class separates the pictures. Opening raises CameraError with the cause.
    """

    def __init__(self, address: Address, open_s: float, read_s: float) -> None:
        import av
        import av.error

        self._address = address
        self._open_s, self._read_s = open_s, read_s
        self._seen = False  # whether a picture has been decoded
        self._newest: Any = None  # newest packet
        self._errors: Any = av.error
        self._jpegs = Jpegs() if address.format == _PARTS else None
        begun = time.monotonic()
        try:
            self._container: Any = av.open(
                address.url,
                format=address.format if self._jpegs is None else "mjpeg",
                options={
                    **(_QUICK if address.format else {}),
                    **({} if self._jpegs is None else _PIECES),
                    **address.options,
                    **DECODING,
                },
                timeout=(open_s, read_s),
                metadata_errors="replace",  # the title of a camera may have any encoding
            )
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise CameraError(
                explain_open_error(error, address, time.monotonic() - begun, open_s, True)
            ) from None
        videos = self._container.streams.video
        if not videos:
            kinds = "".join(f", but {kind}" for kind in sorted({s.type for s in self._container.streams}))
            self._container.close()
            raise CameraError(f"it has no video{kinds}")
        try:
            bound(self._container)
        except TooLargeError as error:
            self._container.close()
            raise CameraError(str(error)) from None
        self._stream = videos[0]
        self._stream.codec_context.thread_count = 1  # threads per frame would delay pictures
        # A stamp shows the age of a picture. Without stamps, a picture must not have waited in a socket for seconds.
        self._passes_over = not address.stamped and self._stream.codec_context.codec.intra_only
        self._frames = self._decoded()

    @property
    def rate(self) -> float:
        """Frame rate [Hz] that the stream states; 25 if it states none."""
        return float(self._stream.average_rate or self._stream.guessed_rate or 25.0)

    def read(self) -> DecodedFrame | None:
        """Return the next picture; None at the end of a file.

        Raises CameraError if it is late or the stream is lost.
        """
        begun = time.monotonic()
        try:
            frame = next(self._frames, None)
            picture = None if frame is None else self._rgb(frame)
        except (self._errors.FFmpegError, OSError, ValueError) as error:
            waited = time.monotonic() - begun
            if self._jpegs is not None and self._is_still and not isinstance(error, self._errors.ExitError):
                raise CameraError(ended(self._address, True, self._jpegs.stated)) from None
            too_large = self._too_large()
            raise CameraError(
                too_large or explain_open_error(error, self._address, waited, self._read_s, not self._seen)
            ) from None
        if frame is None or picture is None:
            if self._jpegs is not None and (not self._seen or self._is_still):
                raise CameraError(ended(self._address, self._is_still, self._jpegs.stated))
            return None
        self._seen = True
        stamp = frame.time if self._address.stamped else None
        return DecodedFrame(picture, None if stamp is None else float(stamp))

    def close(self) -> None:
        """Close the stream and its decoder explicitly: generator and object form a cycle that is collected late."""
        self._frames = iter(())
        self._container.close()

    def _decoded(self) -> Iterator[Any]:
        """Yield decoded frames; packets that cannot be decoded are skipped until the deadline for a picture.

        The first picture may take as long as opening, because many cameras send a key frame only every few seconds.
        """
        since = time.monotonic()
        for packet in self._packets():
            self._newest = packet
            try:
                frames = self._stream.codec_context.decode(packet)
            except self._errors.InvalidDataError:
                frames = []
            for frame in frames:
                yield frame
                since = time.monotonic()
            if time.monotonic() - since > self._allowed:
                raise CameraError(
                    undecodable_text(self._allowed, "" if self._jpegs is None else self._jpegs.stated)
                )

    @property
    def _is_still(self) -> bool:
        """True if the response was a single picture instead of a stream."""
        return self._jpegs is not None and self._jpegs.is_single

    @property
    def _allowed(self) -> float:
        """Longest time until the next picture [s]."""
        return self._read_s if self._seen else max(self._open_s, self._read_s)

    def _too_large(self) -> str:
        """Return a sentence if a picture is too large, else ""."""
        width, height = self._stream.width, self._stream.height
        if self._stream.codec_context.name == "mjpeg" and self._newest is not None:
            import simplejpeg

            with contextlib.suppress(ValueError):  # incomplete header
                height, width, _, _ = simplejpeg.decode_jpeg_header(bytes(self._newest))
        try:
            require_size(width, height)
        except TooLargeError as error:
            return str(error)
        return ""

    def _packets(self) -> Iterator[Any]:
        """Yield packets; a backlog is skipped if the stream has no stamps and every packet is a picture."""
        backlog = Backlog()
        packets = self._container.demux(self._stream) if self._jpegs is None else self._parts(self._jpegs)
        while True:
            begun = time.monotonic()
            packet = next(packets, None)
            if packet is None:
                return
            if not (self._passes_over and backlog.should_skip(time.monotonic() - begun)):
                yield packet

    def _parts(self, jpegs: Jpegs) -> Iterator[Any]:
        """Yield whole JPEG pictures. Raises CameraError if none is complete in time, however many bytes arrive."""
        import av

        since = time.monotonic()
        for piece in self._container.demux(self._stream):
            for picture in jpegs.add(bytes(piece)):
                yield av.Packet(picture)
                since = time.monotonic()
            if time.monotonic() - since > self._allowed:
                if jpegs.is_not_mjpeg:
                    raise CameraError(undecodable_text(self._allowed, jpegs.stated))
                raise CameraError(f"mute: it sent no picture within {self._allowed:g} s")

    def _rgb(self, frame: Any) -> UInt8:
        try:
            require_size(frame.width, frame.height)
            return np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
        except TooLargeError as error:
            raise CameraError(str(error)) from None
        except ValueError:
            raise CameraError(f"its pixel format {frame.format.name} cannot be converted to RGB") from None


# A live stream is analysed only briefly, and frames are not delayed for reordering.
_QUICK = {"fflags": "nobuffer", "flags": "low_delay", "analyzeduration": "500000", "fpsprobesize": "0"}
# Bytes are passed unparsed: a parser recognises the end of a picture only at the start of the next. `raw_packet_size`
# is the largest piece; `probesize` is small because the stream counts as open only after that many bytes, and the first
# picture may take as long.
_PIECES = {"fflags": "noparse+nofillin", "raw_packet_size": str(1 << 16), "probesize": "32"}
