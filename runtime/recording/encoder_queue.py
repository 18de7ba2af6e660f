"""Queue of pictures for one encoder with a bounded lag; a picture that does not fit is replaced by a repeat."""

from __future__ import annotations

import math
import threading
from collections import deque
from typing import NamedTuple

from runtime.core.types import UInt8

RUN = 4  # from this many consecutive repeats on, a few are coded and the others copied
_GUESS_S = (
    0.03  # assumed coding time of a frame [s] before the first measurement, when rows may come in a burst
)


class Picture(NamedTuple):
    """Picture RGB uint8 [H, W, 3] and its capture time [s, monotonic; NaN if unknown]."""

    pixels: UInt8
    captured: float


def encode_count(repeats: int) -> int:
    """Return how many of `repeats` successive repeats must be encoded; the other repeats are copies of encoded frames.

    Fewer than RUN repeats are all encoded. Otherwise two key frames are encoded, and all further repeats are copies of
    these two in turn. Such copies are always appended in pairs, so if `repeats` is odd, one more repeat is encoded
    before the two key frames.
    """
    return repeats if repeats < RUN else 2 + repeats % 2


class Pace:
    """Estimate of the time that it takes at present to encode one frame [s].

    An increase changes the estimate at once, a decrease only over several frames.
    """

    def __init__(self) -> None:
        self.coding_s = _GUESS_S

    def update(self, codings: int, seconds: float) -> None:
        """Record that coding `codings` frames took `seconds`, including waiting for a processor."""
        mean_s = seconds / codings
        self.coding_s = max(mean_s, self.coding_s + 0.2 * (mean_s - self.coding_s))


class PictureQueue:
    """Queue that accepts pictures as long as all its content can be encoded within `max_lag_s` at the present pace.

    At most `places` pictures are stored. Repeats are only counted: of successive repeats at most three are encoded,
    whatever their number. An empty queue accepts a picture even if the encoder is too slow.
    """

    def __init__(self, places: int, max_lag_s: float = math.inf) -> None:
        self._places = places
        self._max_lag_s = max_lag_s
        self._pace = Pace()
        self._held = 0
        self._entries: deque[Picture | int] = (
            deque()
        )  # a picture, or a number of repeats of the previous frame
        self._changed = threading.Condition()
        self._closed = False

    def put(self, picture: UInt8 | None, patience: float = 0.0, captured: float = math.nan) -> bool:
        """Queue one frame; return False if it is queued as a repeat of the previous frame.

        That is so if `picture` is None, or was not accepted within `patience` [s].
        """
        with self._changed:
            if picture is not None and patience:
                self._changed.wait_for(lambda: self._held < self._places or self._closed, patience)
            if picture is not None and self._has_room(patient=patience > 0.0):
                self._entries.append(Picture(picture, captured))
                self._held += 1
                accepted = True
            else:
                self._repeat()
                accepted = False
            self._changed.notify_all()
        return accepted

    def get(self) -> Picture | int | None:
        """Return the oldest entry, waiting for one; None when the queue is closed and empty."""
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
        """Report that coding `codings` frames of an entry took `seconds`, from which the present pace is computed."""
        with self._changed:
            self._pace.update(codings, seconds)

    def close(self, *, discard: bool = False) -> None:
        """Close the queue for new entries; with `discard`, drop the waiting entries."""
        with self._changed:
            self._closed = True
            if discard:
                self._entries.clear()
                self._held = 0
            self._changed.notify_all()

    def waiting(self) -> int:
        """Return the number of frames in the queue."""
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
