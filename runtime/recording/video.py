"""One fragmented H.264 file per camera, encoded on a thread of its own: frame k is the picture of row k."""

from __future__ import annotations

import math
import threading
import time
from array import array
from collections import deque
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter

from runtime.errors import RecordingError
from runtime.recording.files import AppendFile
from runtime.recording.settings import RecordingSettings
from runtime.types import UInt8

GOP_SECONDS = 0.5
FRAGMENT_SECONDS = 0.2  # what a kill can take
# Every frame goes to the muxer at once. x264's look-ahead would halve the size of still scenes, and keep each frame
# for as many periods; without force-cfr it keeps one more to learn its duration.
_AT_ONCE = "scenecut=0:bframes=0:open-gop=0:rc-lookahead=0:mbtree=0:force-cfr=1"
_FRAGMENTS = "frag_keyframe+empty_moov+default_base_moof"


class FragmentedVideo:
    """Encodes RGB pictures one after the other, at pts k / fps; nothing of it is a thread.

    Every finished fragment reaches the file in one write, so that a file without its end, or on a full disk,
    still ends with a whole fragment.
    """

    def __init__(
        self, file: AppendFile, size: tuple[int, int], fps: float, settings: RecordingSettings
    ) -> None:
        self.frames = 0  # encoded so far
        self.muxed = array(
            "d"
        )  # when the packet of each frame went to the muxer [s, monotonic]; in their order
        self._file = file
        self._muxed = _Muxed()
        self._rate = Fraction(fps).limit_denominator(1001)
        self._reformatter = VideoReformatter()
        self._picture = self._planes(np.zeros((*size, 3), dtype=np.uint8))
        options = {
            "movflags": _FRAGMENTS,
            "frag_duration": str(int(FRAGMENT_SECONDS * 1e6)),
            "flush_packets": "1",
        }
        self._container = av.open(self._muxed, "w", format="mp4", options=options)
        self._stream = self._open_stream(size, settings)
        self._container.start_encoding()
        self._store()

    def encode(self, picture: UInt8 | None) -> None:
        """Append one frame: `picture` [H, W, 3], or the previous one (black at first) for None."""
        if picture is not None:
            self._picture = self._planes(picture)
        self._picture.pts = self.frames
        self._picture.time_base = 1 / self._rate
        self._mux(self._stream.encode(self._picture))
        self.frames += 1
        self._store()

    def close(self) -> None:
        """End the file; the descriptor stays open."""
        self._mux(self._stream.encode(None))
        self._container.close()
        self._store()

    def _mux(self, packets: Iterable[Any]) -> None:
        for packet in packets:
            self._container.mux(packet)
            self.muxed.append(time.monotonic())

    def _open_stream(self, size: tuple[int, int], settings: RecordingSettings) -> Any:
        gop = max(1, min(settings.gop, int(GOP_SECONDS * self._rate)))
        stream: Any = self._container.add_stream(settings.codec, rate=self._rate)
        stream.height, stream.width = size
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.time_base = 1 / self._rate
        context.thread_count = 1
        context.colorspace, context.color_range = Colorspace.ITU601, ColorRange.MPEG
        groups = f"keyint={gop}:min-keyint=1:{_AT_ONCE}"
        context.options = {"preset": settings.preset, "crf": str(settings.crf), "x264-params": groups}
        return stream

    def _planes(self, picture: UInt8) -> av.VideoFrame:
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        return self._reformatter.reformat(
            frame, format="yuv420p", dst_colorspace=Colorspace.ITU601, dst_color_range=ColorRange.MPEG
        )

    def _store(self) -> None:
        if self._muxed.bytes:
            self._file.write(self._muxed.bytes)
            self._muxed.bytes = bytearray()


class _Muxed:
    """What the muxer has put out since the last write to the file; no `seek`, so that it never goes back."""

    def __init__(self) -> None:
        self.bytes = bytearray()

    def write(self, data: bytes) -> int:
        self.bytes += data
        return len(data)


class PictureQueue:
    """Pictures on their way to one encoder: a bounded number is held, repeats are only counted."""

    def __init__(self, places: int) -> None:
        self._places = places
        self._held = 0
        self._entries: deque[UInt8 | int] = deque()  # a picture, or how often to repeat the one before
        self._changed = threading.Condition()
        self._closed = False

    def put(self, picture: UInt8 | None, patience: float = 0.0) -> bool:
        """Queue one frame; False where it became a repeat, as no place was free within `patience` seconds."""
        with self._changed:
            if picture is not None and patience:
                self._changed.wait_for(lambda: self._held < self._places or self._closed, patience)
            taken = picture is not None and self._held < self._places
            if picture is not None and taken:
                self._entries.append(picture)
                self._held += 1
            elif self._entries and isinstance(self._entries[-1], int):
                self._entries[-1] += 1
            else:
                self._entries.append(1)
            self._changed.notify_all()
        return taken

    def take(self) -> UInt8 | int | None:
        """The oldest entry, waiting for one; None once the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._entries or self._closed)
            if not self._entries:
                return None
            entry = self._entries.popleft()
            if not isinstance(entry, int):
                self._held -= 1
                self._changed.notify_all()
            return entry

    def close(self, *, discard: bool = False) -> None:
        """No more entries come; with `discard` those that wait are dropped."""
        with self._changed:
            self._closed = True
            if discard:
                self._entries.clear()
                self._held = 0
            self._changed.notify_all()

    def waiting(self) -> int:
        """Frames that were queued and not yet taken."""
        with self._changed:
            return sum(entry if isinstance(entry, int) else 1 for entry in self._entries)


class CameraEncoder:
    """The encoder thread of one camera; `put` never waits for it unless told to."""

    def __init__(
        self, camera: str, path: Path, size: tuple[int, int], fps: float, settings: RecordingSettings
    ) -> None:
        self.camera = camera
        self.path = path
        self.failure: RecordingError | None = None
        self.file = AppendFile(path)
        self._abandoned = False
        self._captured = array("d")  # of each frame that was put [s, monotonic]; NaN for a repeat
        self._queue = PictureQueue(settings.queue_frames)
        try:
            self._video = FragmentedVideo(self.file, size, fps, settings)
        except av.FFmpegError as error:
            self.file.close()
            raise RecordingError(f"camera {camera}: no encoder for {size[1]}x{size[0]}: {error}") from error
        except RecordingError:
            self.file.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"encoder {camera}", daemon=True)
        self._thread.start()

    @property
    def frames(self) -> int:
        """Frames encoded so far; all of them are in the file once the encoder has drained without failure."""
        return self._video.frames

    def put(self, picture: UInt8 | None, patience: float = 0.0, captured: float = math.nan) -> bool:
        """Queue the next row's picture, which must not change any more; False where it became a repeat.

        `captured` is when it was taken, on the monotonic clock of this machine.
        """
        taken = self._queue.put(picture, patience)
        self._captured.append(captured if taken else math.nan)
        return taken

    @property
    def muxed_ms(self) -> dict[str, float] | None:
        """From the capture of a picture until its packet went to the muxer; None where that is not known."""
        muxed = np.array(self._video.muxed)
        taken = muxed - np.array(self._captured)[: len(muxed)]
        taken = taken[np.isfinite(taken)] * 1000.0
        if not len(taken):
            return None
        p50, p99, longest = (float(value) for value in np.percentile(taken, (50, 99, 100)))
        return {"p50": p50, "p99": p99, "max": longest}

    def finish(self) -> None:
        """Ask the thread to encode what waits and to end."""
        self._queue.close()

    def drain(self, deadline: float) -> bool:
        """Wait for the thread's end until `deadline` (time.monotonic); False where it is still at work."""
        self._thread.join(max(0.0, deadline - time.monotonic()))
        return not self._thread.is_alive()

    def abandon(self) -> RecordingError:
        """Give up on a thread that does not end; it writes no more than the frame it is at."""
        waiting = self._queue.waiting()
        self._abandoned = True
        self._queue.close(discard=True)
        return RecordingError(
            f"camera {self.camera}: the encoder did not end in time, "
            f"{waiting} frames not encoded into {self.path}"
        )

    def cancel(self) -> None:
        """End the thread and close the file, for a recording that never began."""
        self._queue.close(discard=True)
        self._thread.join()
        self.file.close()

    def _run(self) -> None:
        try:
            while (entry := self._queue.take()) is not None:
                self._encode(entry)
            if not self._abandoned:
                self._video.close()
        except RecordingError as error:
            self.failure = RecordingError(f"camera {self.camera}: {error}")
        except Exception as error:  # whatever it was: the recording has to say so, and whose it was
            self.failure = RecordingError(f"camera {self.camera}: the encoder failed: {error!r}")
            self._salvage(self.failure)
        finally:
            self._queue.close(discard=True)

    def _encode(self, entry: UInt8 | int) -> None:
        if not isinstance(entry, int):
            self._video.encode(entry)
            return
        for _ in range(entry):
            if self._abandoned:
                return
            self._video.encode(None)

    def _salvage(self, failure: RecordingError) -> None:
        """Write the frames that the failed encoder still holds, where it can."""
        try:
            self._video.close()
        except Exception as error:
            failure.add_note(f"its last frames are lost: {error!r}")
