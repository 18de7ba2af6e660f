"""Recorder of stops on their way to disk and database: a stop waits for neither.

A thread passes each row on: first to a file (see unwritten_commands), then to the database. Repeated presses are
written once a second with a count; until then each has a line in the process journal, which survives a kill.
"""

from __future__ import annotations

import atexit
import errno
import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from threading import Condition, Thread

from django.conf import settings

from evaweb.core.log_throttle import LogThrottle
from evaweb.stations.models import Command, CommandStatus

log = logging.getLogger(__name__)
_APART_S = 1.0  # period of rows with one key
_MOST = 1000  # waiting keys
_EVERY_S = 10.0  # period of log lines about one name
_MOST_NAMES = 16  # names with log lines of their own
_Key = tuple[str, ...]
_Journal = Callable[[Sequence[Command]], object]


class StopRecorder:
    """Queue of rows, which a thread passes to `keep`; that function may wait for the disk.

    `journal` is called with the rows that have to wait, and with an empty sequence when all have been passed on.
    """

    def __init__(
        self,
        keep: Callable[[Command], object],
        clock: Callable[[], float] = time.monotonic,
        journal: _Journal = lambda rows: None,
    ) -> None:
        self._keep, self._clock, self._journal = keep, clock, journal
        self._fresh: deque[tuple[_Key, Command]] = deque(maxlen=_MOST)  # not journaled yet
        self._news = Condition()
        self._waiting: dict[_Key, tuple[Command, int]] = {}
        self._written: dict[_Key, float] = {}
        self._thread: Thread | None = None
        self._nowhere = LogThrottle(_EVERY_S, _MOST_NAMES, clock)
        self._lost = LogThrottle(_EVERY_S, _MOST_NAMES, clock)
        self._failed = LogThrottle(_EVERY_S, _MOST_NAMES, clock)

    def record(self, row: Command) -> None:
        """Queue the row of a stop.

        Rows that arrive within a second with the same `merge_key` are merged: only the newest is written, with the
        number of presses. A press that latched the e-stop anew is not merged.
        """
        key = merge_key(row)
        with self._news:
            self._fresh.append((key, row))
            _, times = self._waiting.pop(key, (row, 0))
            if len(self._waiting) >= _MOST:
                self._drop_one()
            self._waiting[key] = (row, times + 1)
            self._run_soon()

    def _drop_one(self) -> None:
        """Drop the oldest failed stop, for example of an unknown station; if no stop failed, the oldest of all."""
        failed = (key for key, (row, _) in self._waiting.items() if row.status == CommandStatus.FAILED)
        key = next(failed, None)
        lost = self._waiting.pop(key or next(iter(self._waiting)))
        before = "" if key is None else self._lost.suffix_if_due(CommandStatus.FAILED)
        if before is not None:
            log.error(
                "more than %d stops wait to be written down, this is given up: %r%s", _MOST, lost, before
            )

    def write_due(self, *, all_of_them: bool = False) -> float | None:
        """Pass on all rows that are due; return the delay until the next row [s], None if no row is waiting."""
        now = self._clock()
        with self._news:
            self._written = {key: at for key, at in self._written.items() if now - at < _APART_S}
            due = [key for key in self._waiting if all_of_them or key not in self._written]
            due_rows = [(key, *self._waiting.pop(key)) for key in due]
            self._written |= dict.fromkeys(due, now)
            wait = min((self._written[key] + _APART_S - now for key in self._waiting), default=None)
            waiting = [row for key, row in self._fresh if key in self._waiting]
            self._fresh.clear()
        self._write_ahead(waiting)
        failed = [entry for entry in due_rows if not self._try_hand_on(*entry[1:])]
        if failed:
            self._take_back(failed)
            return wait or _APART_S
        if wait is None:
            self._write_ahead([])
        return wait

    def _take_back(self, failed: Sequence[tuple[_Key, Command, int]]) -> None:
        with self._news:
            for key, row, times in failed:
                newer, since = self._waiting.get(key, (row, 0))
                self._waiting[key] = (newer, since + times)
            while len(self._waiting) > _MOST:
                self._drop_one()

    def _write_ahead(self, rows: Sequence[Command]) -> None:
        try:
            self._journal([row for row in rows if _has_station(row)])
        except Exception as error:  # the rows are stored nevertheless, only a kill would lose them
            log.error("a kill would lose %d stops that wait to be written down: %r", len(rows), error)

    def _try_hand_on(self, row: Command, times: int) -> bool:
        """Pass on one row; log an error and return False, so that it is retried and does not block others."""
        try:
            self._hand_on(row, times)
        except Exception:
            before = self._failed.suffix_if_due(row.station.name)
            if before is not None:
                log.exception("%s (%s) is not written down yet%s", row, row.uuid, before)
            return False
        return True

    def _hand_on(self, row: Command, times: int) -> None:
        if times > 1:
            row.data = {**row.data, "times": times}
        if _has_station(row):
            self._keep(row)
            return
        before = self._nowhere.suffix_if_due(row.station.name, times)
        if before is not None:
            log.warning("%s (%s) is not written down: there is no such station%s", row, row.uuid, before)

    def _run_soon(self) -> None:
        if self._thread is None:
            self._thread = Thread(target=self._run, name="notes", daemon=True)
            self._thread.start()
            atexit.register(self.write_due, all_of_them=True)
        self._news.notify()

    def _run(self) -> None:
        wait: float | None = None
        while True:
            with self._news:
                if wait is not None or not self._waiting:
                    self._news.wait(wait)
            wait = self.write_due()


def merge_key(row: Command) -> _Key:
    """Return the key under which presses within a second are merged into one row."""
    user = row.user.get_username() if row.user else ""
    latched_at = str(row.data["carried_out_at"]) if row.data.get("latched") == "anew" else ""
    return (row.station.name, row.kind, user, str(row.status), latched_at)


def _has_station(row: Command) -> bool:
    """Return True if the station exists, or if the disk fails: an extra record is better than a lost one."""
    if row.station.pk is not None:
        return True
    try:
        return (settings.DATA_DIR / "stations" / row.station.name).is_dir()
    except OSError as error:
        return error.errno != errno.ENAMETOOLONG
