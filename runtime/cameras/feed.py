"""An open connection to one camera: pictures in RGB, one after the other, each within a deadline."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.cameras.base import Address, CameraError
from runtime.cameras.finding import found
from runtime.core.picture_bounds import DECODING, TooLargeError, bound, require_size
from runtime.core.types import UInt8

_THERE_S = 0.003  # a packet that comes within was there before it was asked for
_AT_ONCE = 2
_SHOWN = 100


@dataclass(frozen=True, slots=True)
class Frame:
    """A picture uint8 [H, W, 3] RGB and the stream's own time of it [s], None where it has none."""

    picture: UInt8
    stamp: float | None


class Backlog:
    """Notices by the waits for packets that a stream is read more slowly than it comes, and where its end is."""

    def __init__(self) -> None:
        self._waiting = 0  # packets in a row that nobody had to wait for

    def passes(self, waited: float) -> bool:
        """True if the packet waited for so long [s] is to be passed over, as newer ones are there already.

        The first few are not, because two may well come at once; nor is each hundredth: something is shown of a
        stream that never pauses.
        """
        self._waiting = self._waiting + 1 if waited < _THERE_S else 0
        return self._waiting > _AT_ONCE and self._waiting % _SHOWN != 0


class Feed:
    """One stream opened by PyAV; used by one thread, which waits in FFmpeg without the interpreter's lock.

    FFmpeg looks at the deadlines while it waits (PyAV's `timeout`); packets that never become a picture are bounded
    here. Opening raises CameraError that says what was found.
    """

    def __init__(self, address: Address, open_s: float, read_s: float) -> None:
        import av
        import av.error

        self._address = address
        self._open_s, self._read_s = open_s, read_s
        self._seen = False  # a picture
        self._newest: Any = None  # of its packets
        self._errors: Any = av.error
        begun = time.monotonic()
        try:
            self._container: Any = av.open(
                address.url,
                format=address.format,
                options={**(_QUICK if address.format else {}), **address.options, **DECODING},
                timeout=(open_s, read_s),
                metadata_errors="replace",  # a camera's title is written as its maker likes
            )
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise CameraError(found(error, address, time.monotonic() - begun, open_s, True)) from None
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

    def read(self) -> Frame | None:
        """The next picture, None at the end of a file; CameraError where it does not come in time, or is lost."""
        begun = time.monotonic()
        try:
            frame = next(self._frames, None)
            picture = None if frame is None else self._rgb(frame)
        except (self._errors.FFmpegError, OSError, ValueError) as error:
            waited = time.monotonic() - begun
            too_large = self._too_large()
            raise CameraError(
                too_large or found(error, self._address, waited, self._read_s, not self._seen)
            ) from None
        if frame is None or picture is None:
            return None
        self._seen = True
        stamp = frame.time if self._address.stamped else None
        return Frame(picture, None if stamp is None else float(stamp))

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
                frames = packet.decode()
            except self._errors.InvalidDataError:
                frames = []
            for frame in frames:
                yield frame
                since = time.monotonic()
            allowed = self._read_s if self._seen else max(self._open_s, self._read_s)
            if time.monotonic() - since > allowed:
                raise CameraError(f"what it sent for {allowed:g} s cannot be decoded")

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
        backlog, packets = Backlog(), self._container.demux(self._stream)
        while True:
            begun = time.monotonic()
            packet = next(packets, None)
            if packet is None:
                return
            if not (self._passes_over and backlog.passes(time.monotonic() - begun)):
                yield packet

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
