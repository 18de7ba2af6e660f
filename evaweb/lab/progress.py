"""The steps of a start as lines on the terminal: what is being done, and a dot every few seconds while it lasts."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

_DOT_EVERY_S = 5.0


class Progress:
    """Steps that are told as "2 of 6 the simulated bench ...": nothing is silent for long."""

    def __init__(self, write: Callable[[str], object], steps: int) -> None:
        """`write` takes a piece of a line, and shows it at once."""
        self._write, self._steps, self._at = write, steps, 0

    def step(self, what: str) -> AbstractContextManager[None]:
        """The next step, for as long as the block lasts."""
        self._at += 1
        return self.during(f"{self._at} of {self._steps} {what}")

    @contextmanager
    def during(self, what: str) -> Iterator[None]:
        """A line of its own, for as long as the block lasts."""
        self._say(f"{what} ")
        done = threading.Event()
        ticking = threading.Thread(target=self._tick, args=(done,), daemon=True)
        ticking.start()
        try:
            yield
        finally:
            done.set()
            ticking.join()
            self._say("\n")

    def _tick(self, done: threading.Event) -> None:
        while not done.wait(_DOT_EVERY_S):
            self._say(".")

    def _say(self, piece: str) -> None:
        with suppress(
            OSError
        ):  # of a terminal that is gone: what is being done goes on, and is ended in order
            self._write(piece)


def on_terminal(steps: int) -> Progress:
    """One that tells standard error: standard output is for what a command finds."""
    return Progress(lambda piece: print(piece, end="", file=sys.stderr, flush=True), steps)


def silent() -> Progress:
    """One that tells nobody."""
    return Progress(lambda piece: None, 0)
