"""Pictures on their way to one encoder, and how far behind it may be: what it has no time for becomes a repeat."""

from __future__ import annotations

import math
import threading
from collections import deque
from typing import NamedTuple

from runtime.core.types import UInt8

RUN = 4  # repeats that wait together from here on are coded once and copied
_GUESS_S = 0.03  # of the first frame, on a machine of which nothing is known; rows may come in a burst then


class Picture(NamedTuple):
    """A picture RGB uint8 [H, W, 3] and when it was captured [s, monotonic; NaN where that is not known]."""

    pixels: UInt8
    captured: float


def encode_count(repeats: int) -> int:
    """Count of frames to be coded for so many repeats in a row; the rest are copies.

    A run of copies alternates between two key frames and ends with the second, so that an odd one has a
    repeat of its own before it.
    """
    return repeats if repeats < RUN else 2 + repeats % 2


class Pace:
    """Present coding time of one frame [s]: slower at once, faster over some frames."""

    def __init__(self) -> None:
        self.coding_s = _GUESS_S

    def update(self, codings: int, seconds: float) -> None:
        """So many frames were coded in that time, waiting for a processor included."""
        each = seconds / codings
        self.coding_s = max(each, self.coding_s + 0.2 * (each - self.coding_s))


class PictureQueue:
    """Takes pictures as long as all that waits is coded within `max_lag_s`, as far as the pace says.

    At most `places` pictures are held, and repeats are only counted: however long a run of them is, coding it
    takes no longer than three frames. What waits for nothing is taken however slow the encoder is.
    """

    def __init__(self, places: int, max_lag_s: float = math.inf) -> None:
        self._places = places
        self._max_lag_s = max_lag_s
        self._pace = Pace()
        self._held = 0
        self._entries: deque[Picture | int] = deque()  # a picture, or how often to repeat the one before
        self._changed = threading.Condition()
        self._closed = False

    def put(self, picture: UInt8 | None, patience: float = 0.0, captured: float = math.nan) -> bool:
        """Queue one frame; False where it became a repeat, as it could not be taken within `patience` seconds."""
        with self._changed:
            if picture is not None and patience:
                self._changed.wait_for(lambda: self._held < self._places or self._closed, patience)
            if picture is not None and self._has_room(patient=patience > 0.0):
                self._entries.append(Picture(picture, captured))
                self._held += 1
                taken = True
            else:
                self._repeat()
                taken = False
            self._changed.notify_all()
        return taken

    def take(self) -> Picture | int | None:
        """The oldest entry, waiting for one; None once the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._entries or self._closed)
            if not self._entries:
                return None
            entry = self._entries.popleft()
            if isinstance(entry, Picture):
                self._held -= 1
                self._changed.notify_all()
            return entry

    def report_encoded(self, codings: int, seconds: float) -> None:
        """Report the coding time of an entry, for the pace."""
        with self._changed:
            self._pace.update(codings, seconds)

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

    def _has_room(self, *, patient: bool) -> bool:
        if self._held >= self._places:
            return False
        if patient or not self._entries:
            return True
        ahead = sum(encode_count(entry) if isinstance(entry, int) else 1 for entry in self._entries)
        return (ahead + 1) * self._pace.coding_s <= self._max_lag_s

    def _repeat(self) -> None:
        if self._entries and isinstance(self._entries[-1], int):
            self._entries[-1] += 1
        else:
            self._entries.append(1)
