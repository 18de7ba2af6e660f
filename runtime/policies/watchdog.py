"""Cuts what takes too long: one thread for a connection, because one for each request costs more than the request."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator


class Watchdog:
    """Calls what it is given once a deadline has passed; for one watched thread at a time.

    Its thread begins with the first `watching`, and sleeps on from deadline to deadline without being woken between
    them. `end` ends it, from any thread and without waiting; a later `watching` begins another.
    """

    def __init__(self, name: str, cut: Callable[[], None]) -> None:
        self._name = name
        self._cut = cut
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._deadline = math.inf  # of what is under way
        self._wakes = math.inf  # when the thread looks again by itself
        self._fired = False

    @contextlib.contextmanager
    def deadline(self, seconds: float) -> Iterator[Callable[[], bool]]:
        """Cut the work of this context after `seconds`; the function given returns True if that was so."""
        self._begin(time.monotonic() + seconds)
        try:
            yield lambda: self._fired
        finally:
            with self._changed:
                self._deadline = math.inf

    def stop(self) -> None:
        """Nothing is cut any more."""
        with self._changed:
            self._thread, self._deadline = None, math.inf
            self._changed.notify_all()

    def _begin(self, deadline: float) -> None:
        with self._changed:
            self._deadline, self._fired = deadline, False
            if self._thread is None:
                self._thread = threading.Thread(target=self._watch, name=self._name, daemon=True)
                self._thread.start()
            elif deadline < self._wakes:
                self._changed.notify_all()

    def _watch(self) -> None:
        with self._changed:
            while self._thread is threading.current_thread():
                now = time.monotonic()
                if now >= self._deadline:
                    self._deadline, self._fired = math.inf, True
                    self._cut()
                self._wakes = self._deadline
                left = self._deadline - now
                self._changed.wait(None if math.isinf(left) else min(left, threading.TIMEOUT_MAX))
