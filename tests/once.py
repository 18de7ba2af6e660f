"""What is dear to make and never changed: made once for all processes of these tests."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

SHARED = "EVA_TESTS_SHARED"  # the folder of all processes of these tests; tests/conftest.py makes it


def made_once(name: str, make: Callable[[Path], None]) -> Path:
    """A folder with what `make` puts into it: the first process that wants it makes it, others wait."""
    whole = Path(os.environ[SHARED]) / name
    with whole.with_suffix(".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not whole.exists():
            part = whole.with_suffix(".part")
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            make(part)
            part.rename(whole)
    return whole
