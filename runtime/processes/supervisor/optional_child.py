"""Optional child process of a station, which may die without ending it and is restarted with back-off."""

from __future__ import annotations

import logging
import subprocess
import time
from collections.abc import Callable

log = logging.getLogger(__name__)
SHORTEST_S, LONGEST_S = 1.0, 30.0  # shortest and longest pause before a restart [s]
_STEADY_S = 60.0  # run time that resets the pause [s]


class OptionalChild:
    """Child process that is restarted with exponential back-off; a steady run resets it. Call `poll` regularly.

    The robot does not depend on it.
    """

    def __init__(
        self,
        name: str,
        start: Callable[[], subprocess.Popen[bytes]],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._start, self._now = name, start, now
        self._pause = SHORTEST_S
        self._due: float | None = None  # time of the next start
        self._begin()

    def _begin(self) -> None:
        self.process, self._begun, self._due = self._start(), self._now(), None

    def poll(self) -> None:
        """Check whether the child runs; restart it when its back-off is over."""
        if self._due is not None:
            if self._now() >= self._due:
                self._begin()
            return
        code = self.process.poll()
        if code is None:
            return
        steady = self._now() - self._begun >= _STEADY_S
        self._pause = SHORTEST_S if steady else min(2 * self._pause, LONGEST_S)
        self._due = self._now() + self._pause
        log.error("%s: exited with %d; restart in %g s", self._name, code, self._pause)
