"""Worker thread with a queue: messages are answered one after the other, however long each takes."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, Full, Queue
from typing import Any, Protocol

from runtime.clients.channel import json_answers
from runtime.clients.channel.message import Message

log = logging.getLogger(__name__)
WAITING = 64  # messages in one queue
EACH = 8  # messages per connection, so that a flood leaves room for other connections
LATE_S = 4.0  # the older channel's scripts wait 5 s for an answer
_PERIOD_S = 0.1


@dataclass(frozen=True, slots=True)
class Job:
    """Message to answer at `address`; `stops` is the number of stops that were received before it."""

    address: list[bytes]
    holder: str
    message: Message
    came: float
    stops: int


class RequestHandler(Protocol):
    """Handler that answers the messages of a worker."""

    def answer(self, holder: str, message: Message) -> dict[str, Any]: ...
    def close(self) -> None: ...


Reply = Callable[[list[bytes], dict[str, Any]], None]


class RequestWorker:
    """Thread that passes jobs to one handler, and closes the handler at its end.

    `keep` is called about ten times a second. A worker without `keep` is for stops: it executes every job, even jobs
    that are still queued when it ends. Other workers refuse a command that has waited longer than LATE_S, because its
    sender no longer waits, and a command that was followed by a stop.
    """

    def __init__(
        self,
        name: str,
        clerk: RequestHandler,
        reply: Reply,
        stops: Callable[[], int],
        keep: Callable[[], None] | None = None,
    ) -> None:
        self._clerk, self._reply, self._stops, self._keep = clerk, reply, stops, keep
        self._jobs: Queue[Job] = Queue(WAITING)
        self._waiting: Counter[bytes] = Counter()  # jobs by connection
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._kept = 0.0
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> bool:
        """Queue a job; return False if the queue is full, or its connection has too many jobs in it."""
        connection = job.address[0]
        with self._lock:
            if self._waiting[connection] >= EACH:
                return False
            try:
                self._jobs.put_nowait(job)
            except Full:
                return False
            self._waiting[connection] += 1
        return True

    def end(self, patience: float) -> None:
        """Let the worker finish its present job and close its handler; wait at most `patience` [s]."""
        self._over.set()
        self._thread.join(patience)
        if self._thread.is_alive():
            log.error("%s is still busy: left as it is", self._thread.name)

    def _work(self) -> None:
        while not (self._over.is_set() and (self._keep is not None or self._jobs.empty())):
            try:
                job = self._jobs.get(timeout=_PERIOD_S)
            except Empty:
                self._poll_handler()
                continue
            self._forget(job.address[0])
            self._reply(job.address, self._answer(job))
            self._poll_handler()
        self._clerk.close()

    def _forget(self, connection: bytes) -> None:
        with self._lock:
            self._waiting[connection] -= 1
            if not self._waiting[connection]:
                del self._waiting[connection]

    def _answer(self, job: Job) -> dict[str, Any]:
        reason = self._void(job)
        if reason:
            return json_answers.error_answer(reason) | job.message.echo | {"result": "refused"}
        try:
            return self._clerk.answer(job.holder, job.message)
        except Exception as error:  # no message may end the channel
            log.exception("%s cannot be answered", job.message.name)
            return (
                json_answers.error_answer(f"handler error: {type(error).__name__}: {error}")
                | job.message.echo
            )

    def _void(self, job: Job) -> str:
        """Return the reason why a command must not be executed any more, "" if it may be."""
        if self._keep is None or job.message.form == "query":  # stops are always executed
            return ""
        waited = time.monotonic() - job.came
        if job.stops != self._stops():
            return "a stop came after it: not carried out"
        return f"it waited {waited:.1f} s behind others: not carried out" if waited > LATE_S else ""

    def _poll_handler(self) -> None:
        if self._keep is None or time.monotonic() - self._kept < _PERIOD_S:
            return
        self._kept = time.monotonic()
        try:
            self._keep()
        except Exception:  # a lease that is not renewed expires, and the robot holds
            log.exception("periodic work was not done")
