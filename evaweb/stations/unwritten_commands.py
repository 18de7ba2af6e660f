"""Stops that were carried out but are not in the database yet: they wait as files in DATA/unwritten.

There is one file per command and process, so that a restart loses no command, any process may write any of them to the
database, and no process overwrites or removes the answer that another process received. If the disk is full too, this
process holds the newest commands in memory. Commands that a killed process had not stored yet are in its journal.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from uuid import UUID

from django.conf import settings
from django.contrib.auth import get_user_model
from django.db import DataError, Error, IntegrityError, connection

from evaweb.core.log_throttle import LogThrottle
from evaweb.stations.models import Command, Station
from evaweb.stations.process_journal import ProcessJournal, recover_journals
from evaweb.stations.stop_recorder import merge_key
from runtime.recording.files import RecordingError, write_atomic

log = logging.getLogger(__name__)

_MOST = 1000  # commands held in memory
_AGAIN_S = 1.0
_EVERY_S = 60.0  # period of log lines about failed turns
_TIMES = ("issued_at", "answered_at")
_PLAIN = ("kind", "args", "holder", "epoch", "boot", "sequence", "status", "reason", "allowed", "data")


class UnwrittenCommands:
    """Queue of commands, and the thread that retries `write` until the database accepts them.

    `write` raises a database Error if it must be retried. After IntegrityError, DataError or any other exception a
    retry is useless: the command is logged and its file renamed to UUID.PID.refused.
    """

    def __init__(self, write: Callable[[Command], object]) -> None:
        self._write = write
        self._kept: dict[str, bytes] = {}  # commands that the disk did not accept
        self._news = threading.Event()
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None
        self._journal = ProcessJournal(lambda: _folder())
        self._failed = LogThrottle(_EVERY_S, 1)

    def prepare(self, rows: Sequence[Command]) -> None:
        """Journal the commands that will be stored soon, for recovery if this process is killed. Raises: OSError.

        An empty sequence clears the journal: all prepared commands are stored.
        """
        if rows:
            self._journal.add(map(_document, rows))
        else:
            self._journal.clear()

    def store(self, row: Command) -> None:
        """Store a command until the database accepts it; its station and user may be known by name only."""
        name, content = f"{row.uuid}.{os.getpid()}", json.dumps(_document(row)).encode()
        try:
            _folder().mkdir(parents=True, exist_ok=True)
            write_atomic(_path(name), content)
        except (RecordingError, OSError) as error:
            log.error("%s is kept in memory alone: %s", name, error)
            while len(self._kept) >= _MOST:
                lost = self._kept.pop(next(iter(self._kept)))
                log.error(
                    "more than %d commands wait for the database, this one is given up: %r", _MOST, lost
                )
            self._kept[name] = content
        self.start_writing()

    def start_writing(self) -> None:
        """Wake the writer thread; start the thread if it does not run yet.

        The thread also writes the commands of processes that have ended.
        """
        with self._starting:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="unwritten", daemon=True)
                self._thread.start()
        self._news.set()

    def write_all(self) -> bool:
        """Write all stored commands; return True if some must be retried. An unreadable file does not block others."""
        waits = recover_journals(_folder(), self._adopt)
        for name in self._waiting():
            try:
                self._attempt(name)
            except FileNotFoundError:
                continue  # another process has written it
            except OSError as error:
                log.info("%s waits for the disk: %s", name, error)
                waits = True
            except Error as error:
                log.info("the database does not take what was commanded yet: %s", error)
                return True
        return waits

    def _adopt(self, lines: Sequence[bytes]) -> bool:
        """Store the commands in the journal of a process that was killed.

        Presses that are merged into one row of the database (see `merge_key`) are stored as one command with their
        number.

        Returns: Whether all lines were commands; other lines are logged.
        """
        counted: dict[tuple[str, ...], list[Command]] = {}
        whole = True
        for line in lines:
            try:
                row = _row(json.loads(line))
                counted.setdefault(merge_key(row), []).append(row)
            except Exception as fault:  # a file may contain anything
                log.error("a command is not in the database: %r; it was %.9999r", fault, line)
                whole = False
        for rows in counted.values():
            rows[-1].data |= {"times": len(rows)} if len(rows) > 1 else {}
            self.store(rows[-1])
        return whole

    def _run(self) -> None:
        waits = False
        while True:
            if not waits:
                self._news.wait()
            self._news.clear()
            waits = self._turn()
            if waits:
                time.sleep(_AGAIN_S)

    def _turn(self) -> bool:
        """Call `write_all`; survive any error, because the thread must continue."""
        try:
            waits = self.write_all()
            connection.close()
        except Exception:
            before = self._failed.suffix_if_due("")
            if before is not None:
                log.exception("what was commanded is not written yet, and is tried again%s", before)
            return True
        return waits

    def _waiting(self) -> Iterator[str]:
        yield from (
            path.name.removesuffix(".json") for path in sorted(_folder().glob("*.json")) if path.is_file()
        )
        yield from list(self._kept)

    def _attempt(self, name: str) -> None:
        content = self._kept.get(name) or _path(name).read_bytes()
        try:
            self._write(_row(json.loads(content)))
        except Exception as refused:  # a file may contain anything: continue with the next
            if isinstance(refused, Error) and not isinstance(refused, IntegrityError | DataError):
                raise
            log.error("a command is not in the database: %r; it was %.9999r", refused, content)
            if _path(name).exists():
                _path(name).replace(_folder() / f"{name}.refused")
        # Removed only after the write: a crash in between repeats it, and `write` merges rows with the same uuid.
        _path(name).unlink(missing_ok=True)
        self._kept.pop(name, None)


def _folder() -> Path:
    return Path(settings.DATA_DIR) / "unwritten"


def _path(name: str) -> Path:
    return _folder() / f"{name}.json"


def _document(row: Command) -> dict[str, Any]:
    times = {name: at.isoformat() for name in _TIMES if (at := getattr(row, name))}
    user = row.user.get_username() if row.user else ""
    fields = {"uuid": str(row.uuid), "station": row.station.name, "user": user}
    return fields | {name: getattr(row, name) for name in _PLAIN} | times


def _row(document: dict[str, Any]) -> Command:
    times = {name: datetime.fromisoformat(document[name]) for name in _TIMES if name in document}
    user = get_user_model()(username=document["user"]) if document["user"] else None
    plain = {name: document[name] for name in _PLAIN}
    return Command(
        uuid=UUID(document["uuid"]), station=Station(name=document["station"]), user=user, **plain, **times
    )
