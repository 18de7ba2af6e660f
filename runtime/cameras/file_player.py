"""Video file as a camera: played by a thread in step with our clock, or step by step on a virtual clock."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable

from runtime.cameras import file
from runtime.cameras.base import Camera, CameraCondition, CameraError, CameraHealth, CapturedImage
from runtime.cameras.image_transform import ImageTransform
from runtime.cameras.video_stream import DecodedFrame, VideoStream
from runtime.core import realtime
from runtime.core.clock import Clock

log = logging.getLogger(__name__)
_EARLY_S = 1e-6  # [s]; due times are sums of floats
_RETRY_S = 2.0
_JOIN_S = 0.3


class FilePlayer:
    """Player of a video file: it returns each picture from the picture's due time on, and decodes the next in advance.

    Before `start`, and after `reset`, the first picture is repeated at the file's own rate with new capture times.
    """

    def __init__(self, config: file.Config) -> None:
        self._config = config
        self._shape = ImageTransform(config)
        self._feed: VideoStream | None = None
        self._begun: float | None = None
        self.over = False
        self.due = -math.inf

    def start(self, now: float) -> None:
        """Play from the first picture, which is due now."""
        self._begun, self.over = now, False
        self._rewind(now)

    def reset(self, now: float) -> None:
        """Return to the first picture and repeat it from `now` on."""
        self._begun, self.over = None, False
        self._rewind(now)

    def frame_at(self, now: float) -> CapturedImage | None:
        """Return the newest picture that is due and was not returned yet, else None.

        Raises CameraError for an unreadable file.
        """
        if self._feed is None:
            self._rewind(now)
        frame = None
        while not self.over and now + _EARLY_S >= self.due:
            frame = CapturedImage(self._shape(self._next.picture), min(self.due, now), now)
            self._advance(now)
        return frame

    def close(self) -> None:
        """Close the file."""
        if self._feed is not None:
            self._feed.close()
            self._feed = None

    def _rewind(self, due: float) -> None:
        """Return to the first picture, and let it be due at `due`."""
        self.close()
        self._feed = VideoStream(file.address(self._config), self._config.open_s, self._config.read_s)
        first = self._feed.read()
        if first is None:
            self.close()
            raise CameraError("not a video: it has no picture")
        self._next, self._first, self._since, self.due = first, first, due, due

    def _advance(self, now: float) -> None:
        assert self._feed is not None
        period = 1 / self._feed.rate
        if self._begun is None:
            self.due = now + period
            return
        following = self._feed.read()
        if following is not None:
            self._next = following
            self.due = max(self._since + self._offset(following, period), math.nextafter(self.due, math.inf))
        elif self._config.at_end == "loop":
            self._rewind(self.due + period)
        else:
            self.over, self.due = True, math.inf

    def _offset(self, frame: DecodedFrame, period: float) -> float:
        """Return the frame's due time after the first picture [s].

        It follows from the frame's stamp; without one it is `period` after the previous frame.
        """
        if frame.stamp is None or self._first.stamp is None:
            return self.due - self._since + period
        return frame.stamp - self._first.stamp


class FileCamera(Camera):
    """Camera that plays a file.

    If `threaded`, a thread decodes, so that `latest` does not wait; otherwise `latest` decodes.
    """

    kind = "file"

    def __init__(self, key: str, config: file.Config, clock: Clock, threaded: bool) -> None:
        self.key, self.shown = key, file.address(config).shown
        self._clock = clock
        self._player = FilePlayer(config)
        self._threaded = threaded
        self._lock = threading.Lock()
        self._newest: CapturedImage | None = None
        self._health = CameraHealth(CameraCondition.OPENING, clock.now(), "it is being opened")
        self._wake = threading.Event()
        self._ending = False
        self._asked: Callable[[float], None] | None = None  # next request to the player
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        if self._threaded and self._thread is None:
            self._ending = False
            self._thread = threading.Thread(target=self._run, name=f"camera-{self.key}", daemon=True)
            self._thread.start()

    def begin_run(self) -> None:
        self._request(self._player.start)

    def end_run(self) -> None:
        self._request(self._player.reset)

    def _request(self, what: Callable[[float], None]) -> None:
        with self._lock:
            self._asked = what
        self._wake.set()

    def latest(self) -> CapturedImage | None:
        if not self._threaded:
            self._step()
        with self._lock:
            return self._newest

    def health(self) -> CameraHealth:
        with self._lock:
            return self._health

    def request_stop(self) -> None:
        self._ending = True
        self._wake.set()

    def close(self) -> None:
        self.request_stop()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        if not self._threaded:
            self._player.close()

    def _run(self) -> None:
        realtime.leave_realtime()  # decoding must not delay the processes that can stop the robot
        while not self._ending:
            self._step()
            due = self._player.due if self._healthy() else self._clock.now() + _RETRY_S
            wait = due - self._clock.now()
            if wait > 0:
                self._wake.wait(min(wait, _RETRY_S))
                self._wake.clear()
        self._player.close()

    def _healthy(self) -> bool:
        return self.health().condition in (CameraCondition.LIVE, CameraCondition.ENDED)

    def _step(self) -> None:
        """Publish the picture that is due; an error in the file becomes the camera's health.

        A file that breaks while it plays remains lost until a run begins or ends; otherwise it would restart by itself.
        """
        with self._lock:
            requested, self._asked = self._asked, None
            broken = self._health.condition is CameraCondition.LOST
        if broken and requested is None:
            return
        try:
            now = self._clock.now()
            if requested is not None:
                requested(now)
            shot = self._player.frame_at(now)
        except CameraError as error:
            self._fail(str(error))
            return
        except Exception as error:  # a decoder's error must not end the thread or reception
            log.exception("camera %s: playing %s failed", self.key, self.shown)
            self._fail(f"playing it failed: {type(error).__name__}: {error}")
            return
        if shot is not None:
            with self._lock:
                self._newest = shot
        if self._player.over:
            self._set_condition(CameraCondition.ENDED, "the file is over")
        elif shot is not None:
            self._set_condition(CameraCondition.LIVE)

    def _fail(self, reason: str) -> None:
        self._player.close()
        self._set_condition(CameraCondition.LOST if self._newest else CameraCondition.OPENING, reason)

    def _set_condition(self, condition: CameraCondition, reason: str = "") -> None:
        with self._lock:
            before = self._health
            if (condition, reason) != (before.condition, before.why):
                losses = before.losses + (condition is CameraCondition.LOST)
                self._health = CameraHealth(condition, self._clock.now(), reason, losses, failed=bool(reason))
