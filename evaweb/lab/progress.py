"""The steps of a start as lines on the terminal: what is being done, and a line every few seconds while it lasts."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

_EVERY_S = 10.0


class Progress:
    """Steps that are told as "2 of 6 the simulated bench ...": nothing is silent for long."""

    def __init__(self, write: Callable[[str], object], steps: int) -> None:
        """`write` takes a line, and shows it at once."""
        self._write, self._steps, self._at = write, steps, 0

    def step(self, what: str) -> AbstractContextManager[None]:
        """The next step, for as long as the block lasts."""
        self._at += 1
        return self.during(f"{self._at} of {self._steps} {what}")

    @contextmanager
    def during(self, what: str) -> Iterator[None]:
        """A line of its own, for as long as the block lasts."""
        self._say(f"{what}\n")
        done = threading.Event()
        ticking = threading.Thread(target=self._tick, args=(done,), daemon=True)
        ticking.start()
        try:
            yield
        finally:
            done.set()
            ticking.join()

    def _tick(self, done: threading.Event) -> None:
        took = 0.0
        while not done.wait(_EVERY_S):
            took += _EVERY_S
            self._say(f"  ... still at it, {took:.0f} s\n")

    def _say(self, line: str) -> None:
        with suppress(
            OSError
        ):  # of a terminal that is gone: what is being done goes on, and is ended in order
            self._write(line)


def on_terminal(steps: int) -> Progress:
    """One that tells standard error: standard output is for what a command finds."""
    return Progress(lambda line: print(line, end="", file=sys.stderr, flush=True), steps)


def silent() -> Progress:
    """One that tells nobody."""
    return Progress(lambda line: None, 0)
