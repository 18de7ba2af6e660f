"""Enrolment at the lab's end: a thread asks the database, and the number of attempts per minute is limited.

The limit counts per address, so that guessing does not keep computers elsewhere from enrolling.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, Full, Queue, SimpleQueue

from runtime.link.codes import digest
from runtime.link.wire import Enrol, Enrolled

log = logging.getLogger(__name__)
_EACH, _ALL, _WITHIN_S = 10, 100, 60.0  # tries per address and in all, within so many seconds
_STALE_S = 5.0  # [s] after which the computer no longer waits; its code then stays valid
Enroller = Callable[[str, str, str], Enrolled | str]
"""Called with the digest of a code, a key in hexadecimal and the computer's name; returns the result or the refusal."""


class Enrolling:
    """Attempts to enrol and their results. One thread calls `request` and `answers`; both return at once."""

    def __init__(self, enrol: Enroller, clock: Callable[[], float] = time.monotonic) -> None:
        self._enrol, self._clock = enrol, clock
        self._tries: list[tuple[float, str]] = []
        self._asked: Queue[tuple[float, bytes, str, Enrol] | None] = Queue(_EACH)
        self._answered: SimpleQueue[tuple[bytes, Enrolled | str]] = SimpleQueue()
        self._ended = False
        threading.Thread(target=self._work, name="enrolment", daemon=True).start()

    def request(self, route: bytes, address: str, key: str, enrol: Enrol) -> str:
        """Queue an attempt; return the reason if it is refused, "" if it is queued."""
        now = self._clock()
        self._tries = [attempt for attempt in self._tries if now - attempt[0] < _WITHIN_S]
        if len(self._tries) >= _ALL or sum(attempt[1] == address for attempt in self._tries) >= _EACH:
            return f"more than {_EACH} tries to enrol within a minute: wait for a minute"
        self._tries.append((now, address))
        try:
            self._asked.put_nowait((now, route, key, enrol))
        except Full:
            return "too many computers enrol at once: try again in a minute"
        return ""

    def answers(self) -> list[tuple[bytes, Enrolled | str]]:
        """Return the results since the last call, each with its connection."""
        answers = []
        with suppress(Empty):
            while True:
                answers.append(self._answered.get_nowait())
        return answers

    def end(self) -> None:
        """Stop the thread after the current query, without waiting for it: the database may hang."""
        self._ended = True
        with suppress(Full):
            self._asked.put_nowait(None)

    def _work(self) -> None:
        while (request := self._asked.get()) is not None and not self._ended:
            at, route, key, enrol = request
            answer: Enrolled | str = "the lab cannot look the code up now: try again"
            try:
                if self._clock() - at < _STALE_S:
                    answer = self._enrol(digest(enrol.code), key, enrol.computer[:120])
            except Exception:
                log.exception("a computer cannot be enrolled")
            self._answered.put((route, answer))
