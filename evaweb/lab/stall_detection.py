"""Waiting with progress: a slow machine is waited for, a stalled one is not."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from evaweb.core.errors import EvaError

STILL_S = 180.0  # longest time without progress
_AGAIN_S = 0.25
Found = TypeVar("Found")


class DemoFailed(EvaError):
    """Error if the lab's answer is unexpected; the message quotes it."""


class NoReply(DemoFailed):
    """Error if no reply came in time; whether the request was executed is unknown."""


class ProgressTimeout:
    """Timeout since the last progress."""

    def __init__(self, what: str, seconds: float = STILL_S) -> None:
        self._what = what
        self._seconds = seconds
        self._mark: object = None
        self._since = time.monotonic()

    def update(self, mark: object, stands: object) -> None:
        """Record `mark`, which changes with any progress.

        Raises:
            DemoFailed: If it has not changed for too long; the message has `stands`, the current status.
        """
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
    """Call `ask` until its result satisfies `reached`, and return that result; missing replies are retried.

    Raises:
        DemoFailed: If `mark` of the result has not changed for too long.
    """
    patience = ProgressTimeout(what)
    while True:
        try:
            state = ask()
        except NoReply as fault:
            patience.update(None, fault)
        else:
            if reached(state):
                return state
            patience.update(mark(state), state)
        time.sleep(_AGAIN_S)
