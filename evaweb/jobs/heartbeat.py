"""Thread that sends heartbeats during a job."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

from django.db import DatabaseError, InterfaceError, connection

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Lapse:
    """Action `then`, which runs if no heartbeat has reached the database for `after_s` [s], or one was rejected."""

    after_s: float
    then: Callable[[], None]


class Heartbeat:
    """Context manager that calls `beat` every `period_s` [s] until the block ends or `beat` returns False.

    It has its own database connection. If a beat fails, that is logged and the next one is tried; the block continues
    meanwhile. If beats fail for so long that other workers would soon reclaim the job, `lapse` is called.
    """

    def __init__(self, beat: Callable[[], bool], period_s: float, lapse: Lapse | None = None) -> None:
        self._beat = beat
        self._period = period_s
        self._lapse = lapse
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        lapsing = self._lapsing()
        try:
            while not self._over.wait(self._period):
                later = (
                    self._lapsing()
                )  # started before the beat, so that it ends before the database's deadline
                arrived = self._attempt()
                if arrived is None:
                    later.cancel()
                    continue
                lapsing.cancel()
                lapsing = later
                if not arrived:
                    if self._lapse is not None and not self._over.is_set():
                        self._lapse.then()
                    return
        finally:
            lapsing.cancel()
            connection.close()

    def _lapsing(self) -> threading.Timer:
        """Return a timer that runs the action of `lapse` when its time is over; without a lapse, it is not started.

        The timer is a thread of its own, so that a hanging database cannot delay it.
        """
        lapse = self._lapse or Lapse(0.0, lambda: None)
        timer = threading.Timer(lapse.after_s, lapse.then)
        timer.daemon = True
        if self._lapse is not None:
            timer.start()
        return timer

    def _attempt(self) -> bool | None:
        """Return the result of the beat; None if the database does not respond."""
        try:
            return self._beat()
        except (DatabaseError, InterfaceError) as error:
            log.warning("a sign of life did not reach the database: %s", error)
            connection.close()
            return None
