"""Low-priority thread for work on observations that may be late."""

from __future__ import annotations

import os
import threading
from collections import deque
from typing import Any, Protocol

import zmq

from runtime.core.types import Observation
from runtime.ipc.bells import Bell

_LOOK_MS = 200
NICE = 5  # the same as the web's, which shows the pictures


class Work(Protocol):
    """Protocol of work on observations that only some clients want; all methods are called by one thread."""

    @property
    def socket(self) -> zmq.Socket[Any]:
        """Socket that becomes readable when the set of clients may have changed."""

    def is_requested(self) -> bool:
        """Return True if a client wants the work now; called at least every 0.2 s."""

    def __call__(self, observation: Observation) -> None:
        """Process one observation."""


class LowPriorityWorker:
    """Thread that calls `work` with the newest observation; observations that arrive meanwhile replace each other.

    While no client wants the work, nothing is done; a new client gets the newest observation at once. If `work` fails,
    the next call raises its exception.
    """

    def __init__(self, work: Work, nice: int = NICE) -> None:
        self._work = work
        self._nice = nice
        self._bell = Bell.create()
        self._newest: deque[Observation] = deque(maxlen=1)  # not processed yet
        self._wanted = True  # last answer to `work.is_requested`
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
        """End the thread after the present observation."""
        self._closed = True
        self._bell.ring()
        self._thread.join()
        self._bell.close()

    def _run(self) -> None:
        # Linux only: there a thread has a nice value of its own, and its id is accepted as a process id.
        os.setpriority(
            os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + self._nice
        )
        try:
            self._turn_by_turn()
        except (
            Exception
        ) as error:  # any exception must end the process, as if the process had done the work itself
            self._failure = error

    def _turn_by_turn(self) -> None:
        poller = zmq.Poller()
        poller.register(self._work.socket, zmq.POLLIN)
        poller.register(self._bell.descriptor, zmq.POLLIN)
        while not self._closed:
            # Before the newest is read: an observation that came while the work was not wanted has rung no bell.
            self._wanted = self._work.is_requested()
            if self._wanted and self._newest:
                self._work(self._newest.pop())
            else:
                poller.poll(_LOOK_MS)
            self._bell.hush()
