"""Attack in which the database does not respond."""

from __future__ import annotations

import os
import signal
import sqlite3
from collections import Counter
from contextlib import closing
from pathlib import Path

import psutil

from benchmarks.attacks.target import Target

_PATIENCE_MS = 20_000


def hangs(target: Target) -> Counter[str]:
    """Block the database: by an open write transaction (SQLite), or by stopping its processes (PostgreSQL)."""
    if target.database is None:
        return _written_to(target)
    return _not_scheduled(target, target.database)


def _written_to(target: Target) -> Counter[str]:
    with closing(sqlite3.connect(target.data / "eva.sqlite3", isolation_level=None)) as database:
        database.execute(f"PRAGMA busy_timeout = {_PATIENCE_MS}")
        database.execute("BEGIN EXCLUSIVE")
        target.begun()
        target.ended.wait()
        database.execute("ROLLBACK")
    return Counter(locked=1)


def _not_scheduled(target: Target, server: Path) -> Counter[str]:
    first = psutil.Process(int((server / "data" / "postmaster.pid").read_text().split()[0]))
    family = [first, *first.children(recursive=True)]
    for process in family:
        os.kill(process.pid, signal.SIGSTOP)
    try:
        target.begun()
        target.ended.wait()
    finally:
        for process in family:
            os.kill(process.pid, signal.SIGCONT)
    return Counter(stopped=len(family))
