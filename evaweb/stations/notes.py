"""What was done to stop a robot, on its way into the records: nobody who stops waits for disk or database.

A thread of its own takes each row: first into a file of `unwritten`, then into the database. Who presses again and
again is written down once a second, with how often.
"""

from __future__ import annotations

import atexit
import logging
import time
from collections.abc import Callable
from threading import Condition, Thread

from django.conf import settings

from evaweb.stations.models import Command

log = logging.getLogger(__name__)
_APART_S = 1.0  # between two rows of the same
_MOST = 1000  # different ones that wait
_Key = tuple[str, ...]


class Notes:
    """Rows that are handed to `keep`, one after the other, in a thread that may wait for the disk."""

    def __init__(
        self, keep: Callable[[Command], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._keep, self._clock = keep, clock
        self._news = Condition()
        self._waiting: dict[_Key, tuple[Command, int]] = {}
        self._written: dict[_Key, float] = {}
        self._thread: Thread | None = None

    def note(self, row: Command) -> None:
        """Have it written down; of a second's with one station, kind, user and outcome the newest, and how many.

        A press that latched the e-stop anew is never one of many.
        """
        user = row.user.get_username() if row.user else ""
        latched_at = str(row.data["carried_out_at"]) if row.data.get("latched") == "anew" else ""
        key = (row.station.name, row.kind, user, str(row.status), latched_at)
        with self._news:
            _, times = self._waiting.pop(key, (row, 0))
            if len(self._waiting) >= _MOST:
                lost = self._waiting.pop(next(iter(self._waiting)))
                log.error("more than %d stops wait to be written down, this is given up: %r", _MOST, lost)
            self._waiting[key] = (row, times + 1)
            self._run_soon()

    def write(self, *, all_of_them: bool = False) -> float | None:
        """Hand on what is due; in how many seconds the next one is, None where nothing waits [s]."""
        now = self._clock()
        with self._news:
            self._written = {key: at for key, at in self._written.items() if now - at < _APART_S}
            due = [key for key in self._waiting if all_of_them or key not in self._written]
            taken = [self._waiting.pop(key) for key in due]
            self._written |= dict.fromkeys(due, now)
            wait = min((self._written[key] + _APART_S - now for key in self._waiting), default=None)
        for row, times in taken:
            self._hand_on(row, times)
        return wait

    def _hand_on(self, row: Command, times: int) -> None:
        if times > 1:
            row.data = {**row.data, "times": times}
        if row.station.pk is None and not (settings.DATA_DIR / "stations" / row.station.name).is_dir():
            log.warning("%s (%s) is not written down: there is no such station", row, row.uuid)
            return
        try:
            self._keep(row)
        except Exception:  # the next one is written all the same
            log.exception("%s (%s) is not written down", row, row.uuid)

    def _run_soon(self) -> None:
        if self._thread is None:
            self._thread = Thread(target=self._run, name="notes", daemon=True)
            self._thread.start()
            atexit.register(self.write, all_of_them=True)
        self._news.notify()

    def _run(self) -> None:
        wait: float | None = None
        while True:
            with self._news:
                if wait is not None or not self._waiting:
                    self._news.wait(wait)
            wait = self.write()
