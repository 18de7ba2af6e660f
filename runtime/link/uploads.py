"""Station's end of the transfer of episodes to its lab: one at a time, the newest first, with the lowest priority.

The lab requests the bytes that it lacks; nothing else is sent. The rate is limited here.
"""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from runtime.core.errors import CodecError, ConfigurationError, RecordingError
from runtime.ipc.bus import Subscriber
from runtime.ipc.session_state import complete_state_meaning
from runtime.link.contents import Contents, contents_in_steps
from runtime.link.home import Home
from runtime.link.line import Dial, Line
from runtime.link.station_streams import source_of
from runtime.link.wire import (
    EPISODES,
    PIECE,
    STATE,
    Arrived,
    Beat,
    Declined,
    Labels,
    Message,
    Offer,
    Piece,
    Want,
)
from runtime.link.yielding import Throttle

log = logging.getLogger(__name__)
_POLL_MS = 100
_TURN_S = 0.02  # [s], for reading files per turn
_MOST_WANTED = 64
_UNREADABLE_S = 600.0
_SOONEST_S, _LATEST_S = 1.0, 86400.0  # bounds of the pause before a declined offer is repeated [s]
_HEARD_S = 3.0  # [s]; without state for longer, no run is assumed
_LOOK_S = 1.0
_RATE, _LEAST_RATE, _MOST_RATE = 10.0, 0.01, 50.0  # MB/s; the lab cuts off connections above 64


@dataclass(frozen=True, slots=True)
class UploadSettings:
    """Settings of the transfer of a station's episodes.

    `rate` [bytes/s] is its limit, `waits` whether it pauses during a run, `keep_days` the retention at the station
    [days].
    """

    rate: float = _RATE * 1e6
    waits: bool = False
    keep_days: float | None = None

    @classmethod
    def read(cls, given: Mapping[str, str]) -> UploadSettings:
        """Read the settings from environment variables. Raises: ConfigurationError."""
        rate = _number(given, "EVA_UPLOAD_MB_S", _RATE, _LEAST_RATE, _MOST_RATE)
        keep = _number(given, "EVA_KEEP_DAYS", None, 0.0, 36500.0)
        word = given.get("EVA_UPLOAD_WAITS", "no").strip().lower()
        if word not in ("yes", "no", "1", "0"):
            raise ConfigurationError(f"EVA_UPLOAD_WAITS = {word!r:.40}; allowed: yes, no")
        return cls((rate or _RATE) * 1e6, word in ("yes", "1"), keep)


def _number(
    variables: Mapping[str, str], name: str, default: float | None, least: float, most: float
) -> float | None:
    text = variables.get(name, "").strip()
    if not text:
        return default
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not least <= value <= most:
        raise ConfigurationError(f"{name} = {text!r:.40}; allowed: {least:g} to {most:g}")
    return value


class Runs:
    """Monitor of the station's published state that reports whether a run or a recording is active."""

    def __init__(self, context: zmq.Context[Any], station_dir: Path, clock: Callable[[], float]) -> None:
        self._context, self._clock = context, clock
        self._source = source_of(station_dir, STATE)
        self._endpoint = ""
        self._subscriber: Subscriber | None = None
        self._looked = self._heard = -float("inf")
        self._going = False  # last known; True from subscribing to the first state

    def going(self) -> bool:
        """Return True while a run or a recording is active."""
        now = self._clock()
        if now - self._looked >= _LOOK_S:
            self._looked = now
            self._follow(self._source.endpoint())
        with suppress(CodecError, KeyError, TypeError, AttributeError):
            state = self._subscriber.receive(0.0).get("state") if self._subscriber else None
            if state:
                self._going = (
                    complete_state_meaning(state)["state_is"]["at_work"]
                    or (state.get("recording") or {}).get("uuid") is not None
                )
                self._heard = now
        return self._going and now - self._heard < _HEARD_S

    def close(self) -> None:
        """Release the socket."""
        self._follow("")

    def _follow(self, endpoint: str) -> None:
        if endpoint == self._endpoint:
            return
        if self._subscriber is not None:
            self._subscriber.close()
        self._subscriber = Subscriber(self._context, endpoint, "state") if endpoint else None
        self._endpoint, self._going, self._heard = endpoint, bool(endpoint), self._clock()


@dataclass(slots=True)
class _Reading:
    """Episode whose files are being hashed before it is offered."""

    episode: str
    steps: Generator[None, None, Contents]


@dataclass(frozen=True, slots=True)
class _Offered:
    """Offer that the lab has not answered yet: an episode, or its labels if `contents` is None."""

    episode: str
    contents: Contents | None
    lines: bytes = b""


class Uploads:
    """Transfer of one station's episodes. One thread uses it and calls `turn` regularly."""

    def __init__(
        self,
        dial: Dial,
        station_dir: Path,
        settings: UploadSettings,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        assert dial.role == EPISODES
        self._context: zmq.Context[Any] = zmq.Context()
        self._clock, self._settings = clock, settings
        data, lab = station_dir.parent.parent, dial.lab
        self._home = Home(data, lab.station, lab.key, settings.keep_days, clock, wall)
        self._runs = Runs(self._context, station_dir, clock) if settings.waits else None
        self._throttle = Throttle(settings.rate, max(PIECE, settings.rate * _TURN_S), clock)
        self._line = Line(self._context, dial, Beat, clock)
        self._connection = 0
        self._reading: _Reading | None = None
        self._offered: _Offered | None = None
        self._wanted: deque[Want] = deque()
        self._told: dict[str, str] = {}

    def turn(self, wait_ms: int = _POLL_MS) -> None:
        """Wait for the lab, and send the bytes that it has requested, within the time and rate of a turn."""
        self._wait(wait_ms)
        received = self._line.turn()
        if self._line.connections != self._connection or not self._line.up:
            self._connection = self._line.connections
            self._forget()
        for message, _ in received:
            self._handle(message)
        if not self._line.up or (self._runs is not None and self._runs.going()):
            return
        self._send()
        if self._offered is None:
            self._offer()

    def close(self) -> None:
        """Release all sockets."""
        self._line.close()
        if self._runs is not None:
            self._runs.close()
        self._context.destroy(linger=0)

    def _wait(self, wait_ms: int) -> None:
        if self._reading is not None:
            wait_ms = 0
        elif self._wanted:
            wait_ms = min(wait_ms, int(1000 * self._throttle.wait_s()) + 1)
        poller = zmq.Poller()
        if self._line.socket is not None:
            poller.register(self._line.socket, zmq.POLLIN)
        poller.poll(wait_ms)

    def _forget(self) -> None:
        """Drop the offer and the requested pieces, because the connection has ended or the offer was answered."""
        self._offered = self._reading = None
        self._wanted.clear()

    def _handle(self, message: Message) -> None:
        offered = self._offered
        if offered is None or getattr(message, "episode", "") != offered.episode:
            return
        if isinstance(message, Want):
            if len(self._wanted) < _MOST_WANTED:
                self._wanted.append(message)
        elif isinstance(message, Arrived):
            self._forget()
            self._arrived(offered, message)
        elif isinstance(message, Declined):
            self._forget()
            item = offered.episode if offered.contents is not None else f"labels {offered.episode}"
            self._home.put_off(item, min(max(message.again_s, _SOONEST_S), _LATEST_S))
            self._log_once(item, f"the lab does not take it: {message.why}")

    def _arrived(self, offered: _Offered, message: Arrived) -> None:
        try:
            if offered.contents is None:
                self._home.labels_arrived(offered.episode, offered.lines)
            elif message.digest == offered.contents.digest:
                self._home.arrived(offered.episode, offered.contents)
        except RecordingError as error:  # the receipt cannot be written, e.g. disk full: offer again later
            self._home.put_off(offered.episode, _UNREADABLE_S)
            self._log_once(offered.episode, str(error))

    def _send(self) -> None:
        """Send requested bytes as far as the rate limit allows."""
        until = self._clock() + _TURN_S
        while self._wanted and not self._throttle.wait_s() and self._clock() < until:
            want = self._wanted.popleft()
            data = self._read(want)
            self._throttle.consume(max(1, len(data)))
            if not self._line.send(Piece(want.episode, want.file, want.offset), data):
                self._forget()

    def _read(self, want: Want) -> bytes:
        """Return the requested bytes of a file that was offered; b"" for any other file or if it cannot be read."""
        contents = self._offered.contents if self._offered is not None else None
        if contents is None or want.file not in {file.name for file in contents.files}:
            return b""
        try:
            path = self._home.folder(want.episode) / want.file
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                return os.pread(descriptor, min(max(0, want.count), PIECE), max(0, want.offset))
            finally:
                os.close(descriptor)
        except OSError as error:
            self._log_once(want.episode, f"{want.file} cannot be read: {error.strerror}")
            return b""

    def _offer(self) -> None:
        """Offer labels first, because they are small; then the newest episode once all of it is hashed."""
        if self._reading is None:
            labels = self._home.next_labels()
            if labels is not None:
                self._offered = _Offered(labels[0], None, labels[1])
                self._line.send(Labels(labels[0]), labels[1])
                return
            if not (episode := self._home.next()):
                return
            self._reading = _Reading(episode, contents_in_steps(self._home.folder(episode)))
        until = self._clock() + _TURN_S
        try:
            while self._clock() < until:
                next(self._reading.steps)
        except StopIteration as end:
            self._offered = _Offered(self._reading.episode, end.value)
            self._line.send(Offer(self._reading.episode), end.value.packed())
            self._reading = None
        except RecordingError as error:
            self._home.put_off(self._reading.episode, _UNREADABLE_S)
            self._log_once(self._reading.episode, str(error))
            self._reading = None

    def _log_once(self, item: str, reason: str) -> None:
        if self._told.get(item) != reason:
            self._told[item] = reason
            log.warning("episode %s is not sent to the lab: %s", item, reason)
