"""The lock of a station's folder: of each name there is one in a data folder, whether it runs here or elsewhere."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO


class Taken(Exception):
    """Another process has the folder; `by` is what it says of itself."""

    def __init__(self, by: str) -> None:
        self.by = by
        super().__init__(f"process {by} has it")


def take(station_dir: Path, what: str = "") -> IO[str]:
    """The lock, for as long as it is open; raises Taken, or OSError. `what` is said beside the process's number."""
    station_dir.mkdir(parents=True, exist_ok=True)
    lock = (station_dir / "lock").open("a+", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.seek(0)
        by = lock.read().strip() or "?"
        lock.close()
        raise Taken(by) from None
    lock.truncate(0)
    os.write(lock.fileno(), f"{os.getpid()}{what}".encode())
    return lock
