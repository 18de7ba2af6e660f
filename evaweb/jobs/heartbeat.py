"""A thread that shows signs of life while something else is at work."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from types import TracebackType

from django.db import DatabaseError, InterfaceError, connection

log = logging.getLogger(__name__)


class Heartbeat:
    """Calls `beat` every `period_s` seconds until the block is left, or until it returns False.

    It has its own connection to the database. A beat that fails is told to the log and the next one tried:
    the job goes on, and is swept where none arrives for too long.
    """

    def __init__(self, beat: Callable[[], bool], period_s: float) -> None:
        self._beat = beat
        self._period = period_s
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
        try:
            while not self._over.wait(self._period):
                if not self._attempt():
                    return
        finally:
            connection.close()

    def _attempt(self) -> bool:
        try:
            return self._beat()
        except (DatabaseError, InterfaceError) as error:
            log.warning("a sign of life did not reach the database: %s", error)
            connection.close()
            return True
