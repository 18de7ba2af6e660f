"""Progress of a start on the terminal: one line per step, and one every few seconds while it lasts."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

_EVERY_S = 10.0


class Progress:
    """Printer of the steps of a start, for example "2 of 6 the simulated bench".

    During a long step it prints a line every few seconds.
    """

    def __init__(self, write: Callable[[str], object], steps: int) -> None:
        """Initialise; `write` prints a line and flushes it."""
        self._write, self._steps, self._at = write, steps, 0

    def step(self, what: str) -> AbstractContextManager[None]:
        """Report the next step for the duration of the block."""
        self._at += 1
        return self.during(f"{self._at} of {self._steps} {what}")

    @contextmanager
    def during(self, what: str) -> Iterator[None]:
        """Report an unnumbered activity for the duration of the block."""
        self._print(f"{what}\n")
        finished = threading.Event()
        ticking = threading.Thread(target=self._tick, args=(finished,), daemon=True)
        ticking.start()
        try:
            yield
        finally:
            finished.set()
            ticking.join()

    def _tick(self, finished: threading.Event) -> None:
        took = 0.0
        while not finished.wait(_EVERY_S):
            took += _EVERY_S
            self._print(f"  ... still at it, {took:.0f} s\n")

    def _print(self, line: str) -> None:
        with suppress(OSError):  # the terminal is gone: continue, and end in order
            self._write(line)


def on_terminal(steps: int) -> Progress:
    """Return progress on standard error; standard output is for a command's results."""
    return Progress(lambda line: print(line, end="", file=sys.stderr, flush=True), steps)


def silent() -> Progress:
    """Return progress without output."""
    return Progress(lambda line: None, 0)
