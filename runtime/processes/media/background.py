"""Work on observations that may be late: on a thread that gives way to everything else of its process."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

from runtime.core.types import Observation

NICE = 5  # as the web, which is whom live pictures are for


class LowPriorityWorker:
    """Calls `work` with the newest observation; those that come while it is at work replace each other.

    Where `work` fails, the next call raises what it failed with.
    """

    def __init__(self, work: Callable[[Observation], None], nice: int = NICE) -> None:
        self._work = work
        self._nice = nice
        self._changed = threading.Condition()
        self._newest: Observation | None = None
        self._failure: Exception | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="aside", daemon=True)
        self._thread.start()

    def __call__(self, observation: Observation) -> None:
        with self._changed:
            if self._failure is not None:
                raise self._failure
            self._newest = observation
            self._changed.notify()

    def close(self) -> None:
        """End after what is being worked on."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        # Of Linux alone, where a thread has a nice value of its own; its number stands for a process there.
        os.setpriority(
            os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + self._nice
        )
        while (observation := self._taken()) is not None:
            try:
                self._work(observation)
            except (
                Exception
            ) as error:  # whatever it was: the process is to end of it as if it had done the work
                with self._changed:
                    self._failure = error
                return

    def _taken(self) -> Observation | None:
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._closed)
            observation, self._newest = self._newest, None
            return None if self._closed else observation
