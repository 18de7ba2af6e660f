"""Live pages of this process: each station is read once and encoded once for all its viewers."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterable
from typing import Any
from weakref import WeakKeyDictionary

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.console import change_marks, frame_parts
from evaweb.console import viewers as sights
from evaweb.console.encoder import StreamEncoder
from evaweb.console.feed import Feeds, History, LinkState, feeds
from evaweb.console.frame_parts import EncodedPart
from evaweb.console.mailbox import Deliver, Mailbox
from evaweb.stations import redaction as veil
from evaweb.stations.robot_geometry import DrawnRobot

_FLUSH_S = 1 / 40  # minimum time between frames
_STATE_S = 1 / 200  # minimum for the station's state, which is published rarely and should appear at once
_CHANGES_S = 1.0


class StationRoom:
    """Pages that watch one station. Everything except `on_message` belongs to the event loop.

    Users from whom the station's checkpoint is hidden receive redacted parts. The users' visibilities are queried every
    second. New events are held back until the next such query is answered, because a trial that hides a checkpoint may
    have been allocated since the previous one.
    """

    def __init__(self, station: str, robot: str, loop: asyncio.AbstractEventLoop, heard: Feeds) -> None:
        self.station = station
        self._loop = loop
        self._feed = heard.get(station)
        self._encoder = StreamEncoder(robot)
        self._covering = StreamEncoder(robot, veiled=True)
        self._covered: dict[str, EncodedPart] = {}  # newest redacted parts by stream
        self._covers = False  # whether any viewer needs redacted parts
        self._state: dict[str, Any] = {}
        self._unseen = History()  # events held back until the visibilities are known
        self._viewers: set[Mailbox] = set()
        self._newest: dict[str, EncodedPart] = {}
        self._link: LinkState | None = None
        self._history = History()
        self._frames = 0
        self._flushed = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._changes: asyncio.Task[None] | None = None
        self._looking: asyncio.Task[None] | None = None
        self._look_again = False

    @property
    def drawn_robot(self) -> DrawnRobot | None:
        """Robot with the groups that the station reports; None if it is not drawn."""
        return self._encoder.looks

    @property
    def empty(self) -> bool:
        return not self._viewers

    def join(self, deliver: Deliver, user: Any, sight: Visibility) -> Mailbox:
        """Add a page of `user`, with the visibility that was queried when it connected, and return its mailbox."""
        first = not self._viewers
        mailbox = Mailbox(deliver, user)
        mailbox.sight = sight
        self._viewers.add(mailbox)
        self._update_viewer(mailbox)
        if first:
            self._feed.subscribe(self.on_message, pictures=True)
            self._changes = self._loop.create_task(self._follow_changes())
        elif self._link is not None:
            mailbox.put_link(self._link)
        self.schedule_flush()
        return mailbox

    def leave(self, mailbox: Mailbox) -> None:
        """Remove a page; the last one ends the subscription to the feed."""
        self._viewers.discard(mailbox)
        self._count_covered()
        if self._viewers:
            return
        self._feed.unsubscribe(self.on_message)
        for pending in (self._timer, self._changes, self._looking):
            if pending is not None:
                pending.cancel()
        self._timer = self._changes = self._looking = None

    def watch(self, mailbox: Mailbox, streams: Iterable[str]) -> None:
        """Set the streams of a page, and send their newest parts."""
        mailbox.watch(streams, self._shown_to(mailbox).values())
        self.schedule_flush()

    def on_message(self, stream: str, content: Any) -> None:
        """Encode a message of the feed, in the feed's thread, and pass it to the event loop."""
        encoded = self._encoder.encode(stream, content)
        covered = encoded if stream.startswith("camera/") else self._encode_redacted(stream, content)
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._take, stream, content, encoded, covered)

    def _encode_redacted(self, stream: str, content: Any) -> list[EncodedPart]:
        """Return the redacted parts of a message; [] if every viewer may see the unredacted ones."""
        if not self._covers:
            return []
        redacted = veil.redact_state(content, FULL_VISIBILITY) if stream == "state" else content
        return self._covering.encode(stream, redacted)

    def schedule_flush(self, after: float = _FLUSH_S) -> None:
        """Schedule a frame at least `after` [s] after the last one, with everything that arrives until then."""
        at = self._flushed + after
        if self._timer is not None and self._timer.when() <= at:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(at, self._flush)

    def _take(
        self, stream: str, content: Any, encoded: list[EncodedPart], covered: list[EncodedPart]
    ) -> None:
        if stream == "link":
            self._link = content
            for viewer in self._viewers:
                viewer.put_link(content)
        elif stream == "events":
            self._unseen = content
            self._refresh_visibility()
        elif stream == "state":
            self._state = content
            for viewer in self._viewers:
                self._update_viewer(viewer)
        for newest, fresh in ((self._newest, encoded), (self._covered, covered)):
            newest.update((part.stream, part) for part in fresh)
        for viewer in self._viewers:
            for part in covered if viewer.veiled else encoded:
                viewer.put(part)
        if self._viewers:
            self.schedule_flush(_STATE_S if stream in ("state", "link") else _FLUSH_S)

    # --- visibility ---------------------------------------------------------------------------------------------

    def _shown_to(self, viewer: Mailbox) -> dict[str, EncodedPart]:
        return self._covered if viewer.veiled else self._newest

    def _update_viewer(self, viewer: Mailbox) -> None:
        """Update what the page may see of the station now; if that changes, notify the page and resend its streams."""
        veiled = viewer.sight.redacts_snapshot(self.station, self._state)
        viewer.redacts_events = viewer.sight.redacts_events(self.station)
        if veiled is not viewer.veiled:
            viewer.veiled = veiled
            viewer.put_changed(["sight"])
            self._count_covered()
            viewer.watch(viewer.watched, self._shown_to(viewer).values())

    def _count_covered(self) -> None:
        """Update whether any viewer needs redacted parts.

        When the first such viewer appears, redacted parts from before are discarded, because they are outdated.
        """
        before, self._covers = self._covers, any(viewer.veiled for viewer in self._viewers)
        if self._covers and not before:
            self._covered.clear()

    def _refresh_visibility(self) -> None:
        """Look up again what each viewer may see. Events that have already arrived are held back until then."""
        if self._looking is None and self._viewers:
            self._looking = self._loop.create_task(self._looked())
        else:
            self._look_again = True

    async def _looked(self) -> None:
        repeat = True
        try:
            while repeat:
                self._look_again = False
                unseen, viewers = self._unseen, list(self._viewers)
                visibilities = await sights.current_visibilities(
                    {viewer.user.pk: viewer.user for viewer in viewers}
                )
                for viewer in viewers:
                    viewer.sight = visibilities.get(viewer.user.pk, viewer.sight)
                    self._update_viewer(viewer)
                self._history = unseen
                self.schedule_flush()
                repeat = self._look_again
        finally:
            self._looking = None

    def _flush(self) -> None:
        """Send the pending frames to all pages; pages with the same parts get the same bytes."""
        self._timer, self._flushed = None, self._loop.time()
        self._frames += 1
        now, frames = time.monotonic(), {}

        def make_frame(wanted: Iterable[EncodedPart]) -> bytes:
            chosen = tuple(sorted(wanted, key=lambda part: part.stream))
            if chosen not in frames:
                frames[chosen] = frame_parts.build_frame(chosen, self._frames, now)
            return frames[chosen]

        for viewer in self._viewers:
            viewer.flush(self._history, make_frame)

    async def _follow_changes(self) -> None:
        """Notify the pages of database changes by any process."""
        marks_before = None
        while True:
            self._refresh_visibility()
            marks = await change_marks.read_marks(self.station)
            if marks_before is not None and marks is not None and marks != marks_before:
                names = change_marks.changed_names(marks_before, marks)
                for viewer in self._viewers:
                    viewer.put_changed(names)
                self.schedule_flush()
            marks_before = marks or marks_before
            await asyncio.sleep(_CHANGES_S)


class LiveHub:
    """Rooms of all stations with open pages; for one event loop only."""

    def __init__(self, loop: asyncio.AbstractEventLoop, heard: Feeds = feeds) -> None:
        self._loop = loop
        self._feeds = heard
        self._rooms: dict[str, StationRoom] = {}

    def room(self, station: str, robot: str) -> StationRoom:
        """Return the station's room, created for its first page. Join it at once: an empty room is replaced."""
        room = self._rooms.get(station)
        if room is None or room.empty:
            room = self._rooms[station] = StationRoom(station, robot, self._loop, self._feeds)
        return room


_hubs: WeakKeyDictionary[asyncio.AbstractEventLoop, LiveHub] = WeakKeyDictionary()


def hub() -> LiveHub:
    """Return the hub of the running event loop."""
    loop = asyncio.get_running_loop()
    return _hubs.setdefault(loop, LiveHub(loop))
