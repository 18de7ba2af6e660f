"""What tests of real processes and threads look at and wait for."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Found = TypeVar("Found")
_BUSY = 3.0  # times as long as on a quiet machine: deadlines of tests find what never comes, not what is late


def alive(pid: int) -> bool:
    """Whether the process runs; one that only waits to be reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def eventually(check: Callable[[], Found], seconds: float, what: str) -> Found:
    """Wait for something that real processes do in about that time [s]; returns what `check` found."""
    deadline = time.monotonic() + _BUSY * seconds
    while not (found := check()):
        assert time.monotonic() < deadline, f"{what}: not within {_BUSY * seconds:g} s"
        time.sleep(0.02)
    return found
