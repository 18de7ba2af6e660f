"""Lock of a station's folder: a station name runs at most once per data folder, on this machine or another."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO


class StationLockedError(Exception):
    """Error that another process has locked the folder; `by` is its description in the lock file."""

    def __init__(self, by: str) -> None:
        self.by = by
        super().__init__(f"process {by} has it")


def acquire(station_dir: Path, what: str = "") -> IO[str]:
    """Lock the station's folder and return the lock file; the lock lasts until the file is closed.

    The process number is written to the file, followed by `what`.

    Raises:
        StationLockedError: another process has the lock.
        OSError: the lock file cannot be opened.
    """
    station_dir.mkdir(parents=True, exist_ok=True)
    lock = (station_dir / "lock").open("a+", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.seek(0)
        by = lock.read().strip() or "?"
        lock.close()
        raise StationLockedError(by) from None
    lock.truncate(0)
    os.write(lock.fileno(), f"{os.getpid()}{what}".encode())
    return lock
