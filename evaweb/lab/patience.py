"""Waiting for as long as something goes on: a slow machine is waited for, one that stands still is not."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from evaweb.errors import EvaError

STILL_S = 180.0  # without any progress
_AGAIN_S = 0.25
Found = TypeVar("Found")


class DemoFailed(EvaError):
    """The lab answered something else than was asked for; the message has its words."""


class NoReply(DemoFailed):
    """Nothing came in time; whether it was done is not known."""


class ProgressTimeout:
    """Ends where what is waited for makes no progress any more."""

    def __init__(self, what: str, seconds: float = STILL_S) -> None:
        self._what = what
        self._seconds = seconds
        self._mark: object = None
        self._since = time.monotonic()

    def update(self, mark: object, stands: object) -> None:
        """`mark` is another one whenever something went on; VisitFailed says how it `stands` once nothing has."""
        now = time.monotonic()
        if mark != self._mark:
            self._mark, self._since = mark, now
        elif now - self._since > self._seconds:
            raise DemoFailed(f"{self._what}: no progress for {self._seconds:g} s; it is {stands}")


def wait_until(
    ask: Callable[[], Found],
    reached: Callable[[Found], bool],
    what: str,
    mark: Callable[[Found], Any] = lambda found: found,
) -> Found:
    """Result of `ask` once it is `reached`; without a reply it asks again. VisitFailed without progress."""
    patience = ProgressTimeout(what)
    while True:
        try:
            found = ask()
        except NoReply as fault:
            patience.update(None, fault)
        else:
            if reached(found):
                return found
            patience.update(mark(found), found)
        time.sleep(_AGAIN_S)
