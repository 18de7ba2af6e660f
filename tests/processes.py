"""What tests of real processes and threads look at and wait for."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Found = TypeVar("Found")
PATIENCE_S = 60.0 * float(os.environ.get("EVA_TESTS_SLOW", "1"))
"""How long a test waits for what has to come: it finds what never comes, not what is late. No test waits otherwise."""
PATIENCE_MS = round(1000 * PATIENCE_S)


def alive(pid: int) -> bool:
    """Whether the process runs; one that only waits to be reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def joined(*threads: threading.Thread) -> None:
    """Wait for their ends; one that does not come fails, else nobody sees the minute."""
    for thread in threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive(), f"{thread.name} has not ended within {PATIENCE_S:g} s"


def eventually(check: Callable[[], Found], what: str, patience: float = PATIENCE_S) -> Found:
    """Wait until `check` finds something, and return that; `patience` [s] is a multiple of PATIENCE_S for long work."""
    deadline = time.monotonic() + patience
    while not (found := check()):
        assert time.monotonic() < deadline, f"{what}: not within {patience:g} s"
        time.sleep(0.02)
    return found
