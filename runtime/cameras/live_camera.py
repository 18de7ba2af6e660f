"""Live camera, read by a thread that opens it again when it is lost, and conversion of its time stamps to our clock."""

from __future__ import annotations

import logging
import math
import threading
from typing import Protocol

from runtime.cameras.base import (
    Address,
    Camera,
    CameraCondition,
    CameraError,
    CameraHealth,
    CameraSettings,
    CapturedImage,
)
from runtime.cameras.image_transform import ImageTransform
from runtime.cameras.video_stream import DecodedFrame, VideoStream
from runtime.core import realtime
from runtime.core.backoff import BackOff
from runtime.core.clock import Clock, ClockMap


class StreamTime:
    """Conversion of one stream's time stamps to our clock, by the smallest (arrival - stamp) of the last seconds.

    If the stream's clock jumps back or ahead, the conversion starts anew; `jumps` counts both. Returned times always
    increase, because pictures are distinguished by them.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._newest = -math.inf
        self._begin()

    def reset(self) -> None:
        """Start the conversion anew, because a stream that was opened again may begin with any stamp."""
        self._begin()

    def to_monotonic(self, stamp: float | None, arrived: float) -> float:
        """Return our time [s] for the stream's `stamp` [s], at most `arrived`; `arrived` itself without a stamp."""
        time = arrived if stamp is None else self._mapped(stamp, arrived)
        if time <= self._newest:
            time = math.nextafter(self._newest, math.inf)
        self._newest = time
        return time

    def _begin(self) -> None:
        self._map = ClockMap()

    def _mapped(self, stamp: float, arrived: float) -> float:
        before = self._map.restarts + self._map.leaps
        time = self._map.map(stamp, arrived)
        self.jumps += self._map.restarts + self._map.leaps - before
        return time


log = logging.getLogger(__name__)
SETTLE_S = (
    0.3  # time after opening [s] in which pictures may come from a buffer and be older than their arrival
)
_GRACE_S = 1.0  # beyond its own deadline; then the thread is stuck in a driver [s]
_JOIN_S = 0.3


class Stream(Protocol):
    """Open connection to a camera."""

    def read(self) -> DecodedFrame | None:
        """Return the next frame, None if the camera closed the connection. Raises CameraError."""

    def close(self) -> None:
        """Release the connection."""


class LiveCamera(Camera):
    """Camera that is read by a thread; only its newest picture is stored.

    `health` also detects a thread that is stuck in a driver.
    """

    def __init__(self, key: str, kind: str, settings: CameraSettings, address: Address, clock: Clock) -> None:
        self.key, self.kind, self.shown = key, kind, address.shown
        self._settings, self._address, self._clock = settings, address, clock
        self._shape = ImageTransform(settings)
        self._time = StreamTime()
        self._back_off = BackOff()
        self._lock = threading.Lock()
        self._newest: CapturedImage | None = None
        self._health = CameraHealth(CameraCondition.OPENING, clock.now(), "it is being opened")
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"camera-{self.key}", daemon=True)
            self._thread.start()

    def latest(self) -> CapturedImage | None:
        with self._lock:
            return self._newest

    def health(self) -> CameraHealth:
        with self._lock:
            health, newest = self._health, self._newest
        # Computed by the caller, because a thread that is stuck in a driver cannot report itself.
        allowed = self._settings.read_s + _GRACE_S
        if (
            health.condition is CameraCondition.LIVE
            and newest
            and self._clock.now() - newest.arrived > allowed
        ):
            reason = f"no picture for over {allowed:g} s, and reading it does not return"
            return CameraHealth(CameraCondition.LOST, newest.arrived, reason, health.losses + 1, failed=True)
        return health

    def faults(self) -> dict[str, int]:
        """Return the number of jumps of the stream's time as `camera_clock_jumped_<key>`; {} if there were none."""
        return {f"camera_clock_jumped_{self.key}": self._time.jumps} if self._time.jumps else {}

    def request_stop(self) -> None:
        self._ending.set()

    def close(self) -> None:
        """Request the end of reading; a thread that waits for a silent camera ends at its own deadline."""
        self.request_stop()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None

    def _run(self) -> None:
        """Run the reader thread; no error may end it, because nothing else reads the camera."""
        realtime.leave_realtime()  # decoding must not delay the processes that can stop the robot
        while not self._ending.is_set():
            try:
                self._read_until_lost()
            except CameraError as error:
                self._set_lost(str(error))
            except Exception as error:
                log.exception("camera %s: reading failed", self.key)
                self._set_lost(f"reading it failed: {type(error).__name__}: {error}")
            self._ending.wait(self._back_off.remaining_delay(self._clock.now()))

    def _read_until_lost(self) -> None:
        """Open the camera and read it until it is lost, which raises CameraError."""
        feed = self._open_stream()
        try:
            self._time.reset()
            settled: float | None = None
            while not self._ending.is_set():
                frame = feed.read()
                if frame is None:
                    raise CameraError("it closed the connection")
                arrived = self._clock.now()
                settled = arrived + SETTLE_S if settled is None else settled
                captured = self._captured(frame, arrived)
                picture = self._shape(frame.picture)
                if arrived >= settled:
                    self._store(CapturedImage(picture, captured, arrived))
        finally:
            feed.close()

    def _open_stream(self) -> Stream:
        return VideoStream(self._address, self._settings.open_s, self._settings.read_s)

    def _captured(self, frame: DecodedFrame, arrived: float) -> float:
        """Return the frame's capture time on our clock [s]."""
        return self._time.to_monotonic(frame.stamp, arrived)

    def _store(self, shot: CapturedImage) -> None:
        self._back_off.reset()
        with self._lock:
            self._newest = shot
            if self._health.condition is not CameraCondition.LIVE:
                self._health = CameraHealth(CameraCondition.LIVE, shot.arrived, losses=self._health.losses)

    def _set_lost(self, reason: str) -> None:
        now = self._clock.now()
        self._back_off.record_failure(now)
        with self._lock:
            before, lost = self._health, CameraCondition.LOST if self._newest else CameraCondition.OPENING
            since = before.since if before.condition is lost else now
            losses = before.losses + (before.condition is CameraCondition.LIVE)
            self._health = CameraHealth(lost, since, reason, losses, failed=True)
