"""A thread that shows signs of life while something else is at work."""

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
    """`then` is called once no beat has arrived for `after_s` seconds of this machine's clock, or one was refused."""

    after_s: float
    then: Callable[[], None]


class Heartbeat:
    """Calls `beat` every `period_s` seconds until the block is left, or until it returns False.

    It has its own connection to the database. A beat that fails is told to the log and the next one tried:
    the job goes on until its `lapse`, and is swept where none arrives for too long.
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
                later = self._lapsing()  # counted from before the database counts from
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
        """Runs where there is a lapse; whatever hangs here or in the database does not keep it."""
        lapse = self._lapse or Lapse(0.0, lambda: None)
        timer = threading.Timer(lapse.after_s, lapse.then)
        timer.daemon = True
        if self._lapse is not None:
            timer.start()
        return timer

    def _attempt(self) -> bool | None:
        """What the beat returns; None where the database does not answer."""
        try:
            return self._beat()
        except (DatabaseError, InterfaceError) as error:
            log.warning("a sign of life did not reach the database: %s", error)
            connection.close()
            return None
