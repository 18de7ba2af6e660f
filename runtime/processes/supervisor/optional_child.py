"""A process beside the family that may die without ending it: started again, less and less often."""

from __future__ import annotations

import logging
import subprocess
import time
from collections.abc import Callable

log = logging.getLogger(__name__)
SHORTEST_S, LONGEST_S = 1.0, 30.0  # between two starts
_STEADY_S = 60.0  # who lives that long has earned the shortest wait again


class OptionalChild:
    """`look` starts it again where it has ended; the robot does not depend on it."""

    def __init__(
        self,
        name: str,
        start: Callable[[], subprocess.Popen[bytes]],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._start, self._now = name, start, now
        self._pause = SHORTEST_S
        self._due: float | None = None  # when it is started again
        self._begin()

    def _begin(self) -> None:
        self.process, self._begun, self._due = self._start(), self._now(), None

    def poll(self) -> None:
        """See whether it lives; start it again where its time has come."""
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
        log.error("%s ended with %d: started again in %g s", self._name, code, self._pause)
