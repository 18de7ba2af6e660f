"""Work on observations that may be late: on a thread that gives way to everything else of its process."""

from __future__ import annotations

import os
import threading
from collections import deque
from typing import Any, Protocol

import zmq

from runtime.core.types import Observation
from runtime.ipc.bells import Bell

_LOOK_MS = 200
NICE = 5  # as the web, which is whom live pictures are for


class Work(Protocol):
    """Work that somebody may or may not want; all of it is asked by one thread."""

    @property
    def socket(self) -> zmq.Socket[Any]:
        """Can be read when it may be wanted by others than before."""

    def wanted(self) -> bool:
        """True if anybody wants it now; asked every 0.2 s at least."""

    def __call__(self, observation: Observation) -> None:
        """Do it."""


class LowPriorityWorker:
    """Calls `work` with the newest observation; those that come while it is at work replace each other.

    While nobody wants the work nothing of it is done; who begins to want it gets the newest observation at once.
    Where `work` fails, the next call raises what it failed with.
    """

    def __init__(self, work: Work, nice: int = NICE) -> None:
        self._work = work
        self._nice = nice
        self._bell = Bell.made()
        self._newest: deque[Observation] = deque(maxlen=1)  # that was not worked on yet
        self._wanted = True  # as the thread last found
        self._failure: Exception | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="aside", daemon=True)
        self._thread.start()

    def __call__(self, observation: Observation) -> None:
        if self._failure is not None:
            raise self._failure
        self._newest.append(observation)
        if self._wanted:
            self._bell.ring()

    def close(self) -> None:
        """End after what is being worked on."""
        self._closed = True
        self._bell.ring()
        self._thread.join()
        self._bell.close()

    def _run(self) -> None:
        # Of Linux alone, where a thread has a nice value of its own; its number stands for a process there.
        os.setpriority(
            os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + self._nice
        )
        try:
            self._turn_by_turn()
        except Exception as error:  # whatever it was: the process is to end of it as if it had done the work
            self._failure = error

    def _turn_by_turn(self) -> None:
        poller = zmq.Poller()
        poller.register(self._work.socket, zmq.POLLIN)
        poller.register(self._bell.descriptor, zmq.POLLIN)
        while not self._closed:
            # Before the newest is looked at: one that came while nobody wanted it has rung no bell.
            self._wanted = self._work.wanted()
            if self._wanted and self._newest:
                self._work(self._newest.pop())
            else:
                poller.poll(_LOOK_MS)
            self._bell.hush()
