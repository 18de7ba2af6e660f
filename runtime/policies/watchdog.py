"""Watchdog that aborts operations after a deadline, with one thread per connection instead of one per request."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator


class Watchdog:
    """Timer that calls `cut` when a deadline passes, in order to abort a blocking operation. For one watched thread.

    Its thread starts with the first `deadline` and sleeps from deadline to deadline; operations that end in time do not
    wake it. `stop` ends it, from any thread and without waiting; a later `deadline` starts another.
    """

    def __init__(self, name: str, cut: Callable[[], None]) -> None:
        self._name = name
        self._cut = cut
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._deadline = math.inf  # of the present operation
        self._wakes = math.inf  # time of the thread's next check
        self._fired = False

    @contextlib.contextmanager
    def deadline(self, seconds: float) -> Iterator[Callable[[], bool]]:
        """Call `cut` if this context lasts longer than `seconds` [s]; the yielded function returns True if that
        happened.
        """
        self._begin(time.monotonic() + seconds)
        try:
            yield lambda: self._fired
        finally:
            with self._changed:
                self._deadline = math.inf

    def stop(self) -> None:
        """End the thread; `cut` is not called any more."""
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
