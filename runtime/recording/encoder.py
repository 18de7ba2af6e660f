"""Encoder thread of one camera; its failure costs only this camera's video."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from pathlib import Path

import av
import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.types import UInt8
from runtime.recording.digests import rows_per_piece
from runtime.recording.encoder_queue import Picture, PictureQueue, encode_count
from runtime.recording.files import AppendFile, DiskFullError
from runtime.recording.settings import RecordingSettings
from runtime.recording.video import FragmentedVideo

_LEAST, _MOST = 1e-4, 1e5  # [s]; durations outside count as these
_STEP = math.log(1.01)
_BUCKETS = math.ceil(math.log(_MOST / _LEAST) / _STEP) + 1


class DurationHistogram:
    """Histogram of durations [s]; numbers that are not finite are ignored."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BUCKETS, dtype=np.int64)
        self._longest = -math.inf

    def add(self, seconds: float) -> None:
        """Add one duration [s]."""
        if not math.isfinite(seconds):
            return
        within = min(max(seconds, _LEAST), _MOST)
        self._counts[int(math.log(within / _LEAST) / _STEP)] += 1
        self._longest = max(self._longest, seconds)

    def milliseconds(self) -> dict[str, float] | None:
        """Return p50 and p99 with an error of one per cent, and the exact maximum [ms]; None if it is empty."""
        total = int(self._counts.sum())
        if not total:
            return None
        return {
            "p50": self._quantile(0.50, total) * 1000.0,
            "p99": self._quantile(0.99, total) * 1000.0,
            "max": self._longest * 1000.0,
        }

    def _quantile(self, share: float, total: int) -> float:
        """Return the middle of the bucket with the quantile, at most the longest duration."""
        bucket = int(np.searchsorted(np.cumsum(self._counts), share * total))
        return min(_LEAST * math.exp((min(bucket, _BUCKETS - 1) + 0.5) * _STEP), self._longest)


class CameraEncoder:
    """Encoder of one camera's pictures on its own thread.

    `put` waits for a place in the queue only if it is called with a patience.
    """

    def __init__(
        self, camera: str, path: Path, size: tuple[int, int], fps: float, settings: RecordingSettings
    ) -> None:
        self.camera = camera
        self.path = path
        self.failure: RecordingError | None = None
        self.file = AppendFile(path, rows_per_piece(fps))
        self._fps = fps
        self._most_behind = max(2, round(settings.give_up_s * fps))  # [frames]
        self._abandoned = self._refused = self._all_coded = False
        self._captured: deque[float] = (
            deque()
        )  # capture times of the frames in the encoder [s, monotonic]; NaN for a repeat
        self._muxed = DurationHistogram()
        self._queue = PictureQueue(settings.queue_frames, settings.max_lag_s)
        try:
            self._video = FragmentedVideo(self.file, size, fps, settings)
        except (av.FFmpegError, ValueError) as error:
            self.file.close()
            raise RecordingError(
                f"camera {camera}: no encoder {settings.codec} for {size[1]}x{size[0]}: {error}"
            ) from error
        except RecordingError:
            self.file.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"encoder {camera}", daemon=True)
        self._thread.start()

    @property
    def frames(self) -> int:
        """Number of frames encoded so far; all are in the file once `drain` has ended without a failure."""
        return self._video.frames

    @property
    def muxed_ms(self) -> dict[str, float] | None:
        """Return p50, p99 and maximum of the time from capture until the packet went to the muxer [ms].

        None if it is unknown.
        """
        return self._muxed.milliseconds()

    def put(self, picture: UInt8 | None, patience: float = 0.0, captured: float = math.nan) -> bool:
        """Queue the next row's picture, which must no longer change; return False if the row becomes a repeat.

        A failed encoder accepts no pictures, and an encoder that is too far behind fails.

        Args:
            picture: RGB uint8 [H, W, 3]; None repeats the previous one.
            patience: Longest time to wait for a place in the queue [s].
            captured: Capture time on this machine's monotonic clock [s].
        """
        if self.failure is not None:
            self._refused = True
            return False
        accepted = self._queue.put(picture, patience, captured)
        if not patience and not accepted and (waiting := self._queue.waiting()) > self._most_behind:
            self._give_up(
                f"the encoder is {waiting} frames ({waiting / self._fps:.1f} s) behind and is given up"
            )
        return accepted

    def finish(self) -> None:
        """Tell the thread to encode the waiting pictures and to end."""
        self._queue.close()

    def drain(self, deadline: float) -> bool:
        """Wait for the end of the thread until `deadline` (time.monotonic); return False if it still runs."""
        self._thread.join(max(0.0, deadline - time.monotonic()))
        return not self._thread.is_alive()

    def save(self) -> None:
        """Write the part of an ended video that a full disk refused.

        Pictures that were dropped meanwhile are lost, and remain a failure. Raises DiskFullError if the disk refuses
        again.
        """
        if isinstance(self.failure, DiskFullError):
            self._video.close()
            if self._all_coded and not self._refused:
                self.failure = None

    def abandon(self) -> None:
        """Abandon a thread that does not end; it writes at most its current frame."""
        self._abandoned = True
        waiting = self._queue.waiting()
        self._give_up(f"the encoder did not end in time, {waiting} frames not encoded into {self.path}")

    def cancel(self) -> None:
        """End the thread and close the file, for a recording that never began."""
        self._queue.close(discard=True)
        self._thread.join()
        self.file.close()

    def _give_up(self, reason: str) -> None:
        if self.failure is None:
            self.failure = RecordingError(f"camera {self.camera}: {reason}")
        self._queue.close(discard=True)

    def _run(self) -> None:
        try:
            while (entry := self._queue.get()) is not None:
                self._encode_or_fail(entry)
            if not self._abandoned:
                self._all_coded = True
                self._video.close()
        except RecordingError as error:
            self.failure = self.failure or type(error)(f"camera {self.camera}: {error}")
        except Exception as error:  # any error: the recording must report it with the camera
            failure = RecordingError(f"camera {self.camera}: the encoder failed: {error!r}")
            self._salvage(failure)
            self.failure = self.failure or failure
        finally:
            self._queue.close(discard=True)

    def _encode_or_fail(self, entry: Picture | int) -> None:
        """Encode one entry; bytes that a full disk refuses stay in memory until the next write or the end."""
        try:
            self._encode(entry)
        except DiskFullError as error:
            self.failure = self.failure or DiskFullError(f"camera {self.camera}: {error}")

    def _encode(self, entry: Picture | int) -> None:
        begun = time.monotonic()
        if isinstance(entry, int):
            self._captured.extend([math.nan] * entry)
            self._video.repeat(entry)
            self._queue.report_encoded(encode_count(entry), time.monotonic() - begun)
        else:
            self._captured.append(entry.captured)
            self._video.encode(entry.pixels)
            self._queue.report_encoded(1, time.monotonic() - begun)
        while self._captured and len(self._captured) > self._video.frames - self._video.muxed:
            self._muxed.add(self._video.muxed_at - self._captured.popleft())

    def _salvage(self, failure: RecordingError) -> None:
        """Write the frames that the failed encoder still has in memory, if possible; else add a note to `failure`."""
        try:
            self._video.close()
        except Exception as error:
            failure.add_note(f"its last frames are lost: {error!r}")
