"""Queue of messages for one page: newest part of each stream, events, and short texts.

A frame costs one credit, which the page returns when it has drawn the frame; at most two frames are in flight. A page
that does not respond is sent nothing more, so that its memory use is bounded.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.console.feed import History, LinkState
from evaweb.console.frame_parts import EncodedPart
from evaweb.core.errors import reasoned
from evaweb.stations import redaction as veil

CREDITS = 2
EVENTS_AT_ONCE = 200
_TEXTS_UNHEARD = 30  # texts without any message from the page, after which no more are sent
Deliver = Callable[[str | bytes], None]
MakeFrame = Callable[[Iterable[EncodedPart]], bytes]


class Mailbox:
    """Messages of one page at one station; for the event loop only.

    `sight` is the visibility of the page's user, from which two attributes follow. `veiled` is True if the user must
    not see which checkpoint the station is set up for; `redacts_events` is True if the station's events must be
    redacted for the user.
    """

    def __init__(self, deliver: Deliver, user: Any = None) -> None:
        self.user = user
        self.sight: Visibility = FULL_VISIBILITY
        self.veiled = self.redacts_events = False
        self._deliver = deliver
        self._watched: frozenset[str] = frozenset()
        self._pending: dict[str, EncodedPart] = {}
        self._credits = CREDITS
        self._unheard = 0
        self._link: LinkState | None = None
        self._changed: set[str] = set()
        self._events_of = ""  # boot whose events the page has
        self._events_after: int | None = None  # None: events were not requested
        self._covered_up_to = (
            0,
            0,
        )  # number of the last event processed, and of the last redacted event sent

    @property
    def watched(self) -> frozenset[str]:
        return self._watched

    def watch(self, streams: Iterable[str], newest: Iterable[EncodedPart]) -> None:
        """Set the streams of the page, and queue their `newest` parts."""
        self._watched = frozenset(streams)
        self._pending = {part.stream: part for part in newest if part.stream in self._watched}

    def put(self, part: EncodedPart) -> None:
        """Queue a part; it replaces an older one of the same stream."""
        if part.stream in self._watched:
            self._pending[part.stream] = part

    def put_link(self, link: LinkState) -> None:
        self._link = link

    def put_changed(self, what: Iterable[str]) -> None:
        self._changed.update(what)

    def want_events(self, after: int, boot: str) -> None:
        """Set which events the page is sent from now on: those of `boot` after number `after`."""
        self._events_after, self._events_of, self._covered_up_to = after, boot, (0, 0)

    def credit(self) -> None:
        """Add a credit: the page has drawn a frame."""
        self._credits = min(CREDITS, self._credits + 1)

    def mark_read(self) -> None:
        """Record that the page is responsive."""
        self._unheard = 0

    def flush(self, history: History, make_frame: MakeFrame) -> None:
        """Send everything that may be sent now."""
        link = self._link
        if link is not None and self._send({"type": "link", "ok": link.ok, **reasoned(link.reason)}):
            self._link = None
        if self._changed and self._send({"type": "changed", "what": sorted(self._changed)}):
            self._changed.clear()
        self._flush_events(history)
        if self._pending and self._credits:
            self._credits -= 1
            pending, self._pending = self._pending, {}
            self._deliver(make_frame(pending.values()))

    def _flush_events(self, history: History) -> None:
        if self._events_after is None or not history.boot:
            return
        self._events_of = self._events_of or history.boot
        beyond = (
            not self.redacts_events and self._events_after > history.newest
        )  # redacted events have numbers of their own, which may be higher
        if self._events_of != history.boot or beyond:
            self._events_of, self._events_after, self._covered_up_to = history.boot, 0, (0, 0)
        rows: Sequence[Any] = history.after(self._events_after)
        covered: Sequence[Any] = ()
        if self.redacts_events:
            number, last = self._covered_up_to
            covered = veil.redact_events(history.after(number), self.sight, last)
            rows = [row for row in covered if row["number"] > self._events_after]
        for start in range(0, len(rows), EVENTS_AT_ONCE):
            some = rows[start : start + EVENTS_AT_ONCE]
            mark = {"covered": True} if self.redacts_events else {}
            if not self._send({"type": "events", "boot": history.boot, "events": some, **mark}):
                return
            self._events_after = some[-1]["number"]
        last = covered[-1]["number"] if covered else self._covered_up_to[1]
        self._covered_up_to = (history.newest, last) if self.redacts_events else (0, 0)

    def _send(self, message: dict[str, object]) -> bool:
        """Send a text, unless the page has left many texts unanswered; return whether it was sent."""
        if self._unheard >= _TEXTS_UNHEARD:
            return False
        self._unheard += 1
        self._deliver(json.dumps(message, separators=(",", ":"), allow_nan=False))
        return True
