"""An open connection to one camera: pictures in RGB, one after the other, each within a deadline."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.cameras.base import Address, CameraError
from runtime.cameras.finding import ended, explain_open_error, others
from runtime.cameras.jpegs import Jpegs
from runtime.core.picture_bounds import DECODING, TooLargeError, bound, require_size
from runtime.core.types import UInt8

_THERE_S = 0.003  # a packet that comes within was there before it was asked for
_AT_ONCE = 2
_SHOWN = 100
_PARTS = "mpjpeg"  # FFmpeg's name; its reader refuses streams whose parts are not described to the letter


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """A picture uint8 [H, W, 3] RGB and the stream's own time of it [s], None where it has none."""

    picture: UInt8
    stamp: float | None


class Backlog:
    """Notices by the waits for packets that a stream is read more slowly than it comes, and where its end is."""

    def __init__(self) -> None:
        self._waiting = 0  # packets in a row that nobody had to wait for

    def should_skip(self, waited: float) -> bool:
        """True if the packet waited for so long [s] is to be passed over, as newer ones are there already.

        The first few are not, because two may well come at once; nor is each hundredth: something is shown of a
        stream that never pauses.
        """
        self._waiting = self._waiting + 1 if waited < _THERE_S else 0
        return self._waiting > _AT_ONCE and self._waiting % _SHOWN != 0


class VideoStream:
    """One stream opened by PyAV; used by one thread, which waits in FFmpeg without the interpreter's lock.

    FFmpeg looks at the deadlines while it waits (PyAV's `timeout`); packets that never become a picture are bounded
    here. Of JPEG pictures in parts FFmpeg fetches the bytes alone. Opening raises CameraError that says what was found.
    """

    def __init__(self, address: Address, open_s: float, read_s: float) -> None:
        import av
        import av.error

        self._address = address
        self._open_s, self._read_s = open_s, read_s
        self._seen = False  # a picture
        self._newest: Any = None  # of its packets
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
                metadata_errors="replace",  # a camera's title is written as its maker likes
            )
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise CameraError(
                explain_open_error(error, address, time.monotonic() - begun, open_s, True)
            ) from None
        videos = self._container.streams.video
        if not videos:
            others = "".join(f", but {kind}" for kind in sorted({s.type for s in self._container.streams}))
            self._container.close()
            raise CameraError(f"it has no video{others}")
        try:
            bound(self._container)
        except TooLargeError as error:
            self._container.close()
            raise CameraError(str(error)) from None
        self._stream = videos[0]
        self._stream.codec_context.thread_count = 1  # frame threads hold pictures back
        # A stamp tells how old a picture is. Where there is none, it must not have lain in a socket for seconds.
        self._passes_over = not address.stamped and self._stream.codec_context.codec.intra_only
        self._frames = self._decoded()

    @property
    def rate(self) -> float:
        """Pictures per second as the stream says, 25 where it does not [Hz]."""
        return float(self._stream.average_rate or self._stream.guessed_rate or 25.0)

    def read(self) -> DecodedFrame | None:
        """The next picture, None at the end of a file; CameraError where it does not come in time, or is lost."""
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
        """Let it go, with its decoder: the generator and this hold each other, and the collector comes late."""
        self._frames = iter(())
        self._container.close()

    def _decoded(self) -> Iterator[Any]:
        """Decoded frames; packets that cannot be decoded are skipped for as long as pictures may be awaited.

        The first picture may take as long as opening: many cameras send one that stands for itself every few seconds.
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
                raise CameraError(others(self._allowed, "" if self._jpegs is None else self._jpegs.stated))

    @property
    def _is_still(self) -> bool:
        """True if the answer was one picture and not a stream of them."""
        return self._jpegs is not None and self._jpegs.is_single

    @property
    def _allowed(self) -> float:
        """Seconds until the next picture, at the most."""
        return self._read_s if self._seen else max(self._open_s, self._read_s)

    def _too_large(self) -> str:
        """Sentence on the size of the newest picture, "" where it is none that no camera has."""
        width, height = self._stream.width, self._stream.height
        if self._stream.codec_context.name == "mjpeg" and self._newest is not None:
            import simplejpeg

            with contextlib.suppress(ValueError):  # no whole header
                height, width, _, _ = simplejpeg.decode_jpeg_header(bytes(self._newest))
        try:
            require_size(width, height)
        except TooLargeError as error:
            return str(error)
        return ""

    def _packets(self) -> Iterator[Any]:
        """As they come; of a stream without stamps whose every packet is a picture, without those of a backlog."""
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
        """Whole JPEG pictures; CameraError where none comes in time, however many bytes do."""
        import av

        since = time.monotonic()
        for piece in self._container.demux(self._stream):
            for picture in jpegs.add(bytes(piece)):
                yield av.Packet(picture)
                since = time.monotonic()
            if time.monotonic() - since > self._allowed:
                if jpegs.is_other:
                    raise CameraError(others(self._allowed, jpegs.stated))
                raise CameraError(f"mute: it sent no picture within {self._allowed:g} s")

    def _rgb(self, frame: Any) -> UInt8:
        try:
            require_size(frame.width, frame.height)
            return np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
        except TooLargeError as error:
            raise CameraError(str(error)) from None
        except ValueError:
            raise CameraError(f"its pixel format {frame.format.name} cannot be made RGB") from None


# A live stream is not studied for long, and nothing is kept back for order's sake.
_QUICK = {"fflags": "nobuffer", "flags": "low_delay", "analyzeduration": "500000", "fpsprobesize": "0"}
# Bytes as they come, unparsed: a parser knows a picture by the beginning of the next. At the most so many, and some of
# them before it counts as open: the first picture may take as long as that.
_PIECES = {"fflags": "noparse+nofillin", "raw_packet_size": str(1 << 16), "probesize": "32"}
