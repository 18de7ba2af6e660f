"""Feed of a station's published messages, read in threads of this process, which reconnect when the runtime restarts.

The feed depends neither on pages nor on the database. Listeners are called in the feed's threads and must not block.
"""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import zmq

from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import StationGone
from evaweb.stations.runtime_client import StationConnection, connection_to
from runtime.core.sentences import Pattern
from runtime.ipc.bus import CodecError, Subscriber
from runtime.ipc.session_state import complete_state_meaning

_UNHEARD = Pattern("console.feed.unheard", "{station}: no message received yet")


log = logging.getLogger(__name__)
EVENTS_KEPT = 2000
_SILENCE_S = 1.5  # ten snapshots are published per second
_TURN_S = 0.2
_EVENTS_S = 1.0
_NEEDED = ("boot", "newest_event", "state", "lease")  # keys that a snapshot must have
Listener = Callable[[str, Any], None]  # called with the stream (also "link", "events") and its newest content


@dataclass(frozen=True, slots=True)
class LinkState:
    """State of the link to a station's runtime; `reason` explains why it is not `ok`."""

    ok: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class History:
    """Last events of one boot of the runtime, numbered without gaps."""

    boot: str = ""
    rows: tuple[dict[str, Any], ...] = ()

    @property
    def newest(self) -> int:
        return int(self.rows[-1]["number"]) if self.rows else 0

    def after(self, number: int) -> tuple[dict[str, Any], ...]:
        """Return the events after `number`."""
        behind = self.newest - number
        return self.rows[-behind:] if behind > 0 else ()

    def extended(self, boot: str, rows: list[dict[str, Any]]) -> History:
        """Return the history with newer events appended; a new boot starts an empty history."""
        before = self.rows if boot == self.boot else ()
        last = before[-1]["number"] if before else 0
        fresh = tuple(row for row in rows if row["number"] > last)
        return History(boot, (*before, *fresh)[-EVENTS_KEPT:])


class _Reader(ABC):
    """Thread that reads one socket of a station and follows it across restarts of the runtime."""

    def __init__(self, wire: StationConnection, process: str, key: str, streams: tuple[str, ...]) -> None:
        self._wire, self._process, self._key, self._streams = wire, process, key, streams
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{wire.name} {key}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def end(self) -> None:
        """Request the end; the thread ends within a fraction of a second."""
        self._ended.set()

    @abstractmethod
    def on_messages(self, found: Mapping[str, Any]) -> None:
        """Pass on the newest message of each stream that had one; `found` maps streams to their content."""

    def on_silence(self, reason: str) -> None:  # noqa: B027  # who reads pictures leaves it to who reads the state
        """Report that no messages arrive, with the reason."""

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                self._follow(self._wire.address(self._process, self._key))
            except StationGone as gone:
                self.on_silence(str(gone))
            except zmq.ZMQError as error:  # the address in the file is invalid
                self.on_silence(f"the address of {self._wire.name} cannot be used: {error.strerror}")
            except (
                Exception
            ):  # a runtime of another version may publish anything; its successor may be compatible
                log.exception("%s published what this web cannot use", self._wire.name)
                self.on_silence(
                    f"{self._wire.name} publishes what this web cannot use: see the log of the web"
                )
            self._ended.wait(_TURN_S)

    def _follow(self, endpoint: str) -> None:
        """Read until the runtime has another address."""
        silent_s = 0.0
        before = looked = time.monotonic()
        with closing(Subscriber(zmq.Context.instance(), endpoint, *self._streams)) as subscriber:
            while not self._ended.is_set():
                messages = self._receive(subscriber)
                now = time.monotonic()
                # A turn that lasted longer counts as two: this process stood still itself, and heard nobody meanwhile.
                silent_s = 0.0 if messages else silent_s + min(now - before, 2 * _TURN_S)
                before = now
                if messages:
                    self.on_messages(messages)
                elif silent_s > _SILENCE_S:
                    self.on_silence(
                        f"no sign of life from {self._wire.name}: was its runtime ended, or does it hang?"
                    )
                if now - looked >= _TURN_S:
                    looked = now
                    if self._wire.address(self._process, self._key) != endpoint:
                        return

    def _receive(self, subscriber: Subscriber) -> Mapping[str, Any]:
        try:
            return subscriber.receive(_TURN_S)
        except CodecError as error:
            log.error("%s published what cannot be read: %s", self._wire.name, error)
            return {}


class _StateReader(_Reader):
    """Reader of state and events from the coordinator."""

    def __init__(self, feed: StationFeed, wire: StationConnection) -> None:
        super().__init__(wire, "coordinator", "state", ("state", "event"))
        self._feed = feed

    def on_messages(self, found: Mapping[str, Any]) -> None:
        feed = self._feed
        if feed.link != LinkState(True):
            feed.dispatch("link", LinkState(True))
        if "state" in found:
            feed.dispatch("state", _check_snapshot(found["state"]))
        if "event" in found or self._behind():
            self._catch_up()

    def on_silence(self, reason: str) -> None:
        if self._feed.link != LinkState(False, reason):
            log.warning("%s", reason)
            self._feed.dispatch("link", LinkState(False, reason))

    def _behind(self) -> bool:
        state, history = self._feed.state, self._feed.history
        return bool(state) and (state["boot"], state["newest_event"]) != (history.boot, history.newest)

    def _catch_up(self) -> None:
        """Request the events after the last known one.

        Published events may be lost, so they only signal that there are new ones.
        """
        history = self._feed.history
        try:
            boot, rows = self._wire.events_since(history.newest, timeout=_EVENTS_S)
            if boot != history.boot and history.newest:
                boot, rows = self._wire.events_since(0, timeout=_EVENTS_S)
        except StationGone as gone:
            log.warning("events of %s are late: %s", self._wire.name, gone)
            return
        if rows or boot != history.boot:
            self._feed.dispatch("events", history.extended(boot, rows))


def _check_snapshot(state: Any) -> dict[str, Any]:
    """Return a snapshot as JSON values.

    Raises:
        ValueError: If it lacks a key that the web needs.
    """
    missing = [key for key in _NEEDED if not isinstance(state, Mapping) or key not in state]
    if missing:
        raise ValueError(f"a snapshot without {', '.join(missing)}: {state!r:.200}")
    return complete_state_meaning(to_json_value(state))


class _Shown(_Reader):
    """Reader of streams that are only displayed; it passes their messages to the feed unchanged."""

    def __init__(
        self, feed: StationFeed, wire: StationConnection, process: str, key: str, *streams: str
    ) -> None:
        super().__init__(wire, process, key, streams)
        self._feed = feed

    def on_messages(self, found: Mapping[str, Any]) -> None:
        for stream, content in found.items():
            self._feed.dispatch(stream, content)


def _motion(feed: StationFeed, wire: StationConnection) -> _Reader:
    """Return a reader of joints and chunks from the coordinator."""
    return _Shown(feed, wire, "coordinator", "state", "joints", "chunk")


def _pictures(feed: StationFeed, wire: StationConnection) -> _Reader:
    """Return a reader of camera previews from the media process."""
    return _Shown(feed, wire, "media", "cameras", "camera/")


class StationFeed:
    """Feed of one station; `link`, `state` and `history` are the newest values and may be read from any thread."""

    def __init__(self, station: str) -> None:
        self.station = station
        self.link = self._unheard()
        self.state: dict[str, Any] = {}
        self.history = History()
        self._wire = connection_to(station)
        self._listeners: dict[Listener, bool] = {}  # whether each listener needs images and motion
        self._lock = threading.Lock()
        self._numbers: _Reader | None = None
        self._motion: _Reader | None = None
        self._pictures: _Reader | None = None

    def subscribe(self, listener: Listener, *, pictures: bool) -> None:
        """Call `listener` with the values that are known now, then with every message.

        The first listener starts the threads. Images, joints and chunks are read only while there is a listener that
        was subscribed with `pictures`.
        """
        with self._lock:
            self._listeners[listener] = pictures
            listener("link", self.link)
            if self.state:
                listener("state", self.state)
            listener("events", self.history)
        self._adjust()

    def unsubscribe(self, listener: Listener) -> None:
        """Remove a listener; the threads end with the last one."""
        with self._lock:
            self._listeners.pop(listener, None)
            if not self._listeners:  # later changes would be missed, so nothing is known any more
                self.link, self.state = self._unheard(), {}
        self._adjust()

    def _unheard(self) -> LinkState:
        return LinkState(False, _UNHEARD(station=self.station))

    def dispatch(self, stream: str, content: Any) -> None:
        """Store a message, and pass it to the listeners."""
        with self._lock:
            if stream == "link":
                self.link = content
            elif stream == "state":
                self.state = content
            elif stream == "events":
                self.history = content
            for listener in self._listeners:
                listener(stream, content)

    def _adjust(self) -> None:
        with self._lock:
            is_watched, pictures = bool(self._listeners), any(self._listeners.values())
            self._numbers = self._switched(self._numbers, is_watched, _StateReader)
            self._motion = self._switched(self._motion, pictures, _motion)
            self._pictures = self._switched(self._pictures, pictures, _pictures)

    def _switched(
        self,
        reader: _Reader | None,
        is_needed: bool,
        kind: Callable[[StationFeed, StationConnection], _Reader],
    ) -> _Reader | None:
        if is_needed and reader is None:
            reader = kind(self, self._wire)
            reader.start()
        elif not is_needed and reader is not None:
            reader.end()
            reader = None
        return reader


class Feeds:
    """Feeds of a process, one per station, shared by its pages and its event ingest."""

    def __init__(self) -> None:
        self._feeds: dict[str, StationFeed] = {}
        self._lock = threading.Lock()

    def get(self, station: str) -> StationFeed:
        """Return the station's feed, created on first use."""
        with self._lock:
            return self._feeds.setdefault(station, StationFeed(station))


feeds = Feeds()
