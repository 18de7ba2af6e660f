"""Closed episodes are exported by a process of lowest priority: nothing that is received or sent waits for it."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
import time
from pathlib import Path

log = logging.getLogger(__name__)


class Exports:
    """Exports into one data folder; each of its processes ends with ours, however that ends."""

    def __init__(self, data: Path) -> None:
        self._data = data
        self._under_way: list[threading.Thread] = []

    def start(self, folder: Path) -> None:
        """Export the closed episode in `folder`; returns at once, what goes wrong is logged."""
        command = (sys.executable, "-m", "runtime.recording", "export", str(folder), "--to", str(self._data))
        try:
            child = subprocess.Popen(
                (*command, "--background"),
                stdin=subprocess.PIPE,  # its end is ours
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        except OSError as error:
            log.error("%s is not exported: %s", folder, error)
            return
        attending = threading.Thread(target=_attend, args=(child, folder), name="export", daemon=True)
        attending.start()
        self._under_way = [*(one for one in self._under_way if one.is_alive()), attending]

    def finish(self, seconds: float) -> None:
        """Wait for what is under way, at most so long; the rest is exported when it is asked for again."""
        deadline = time.monotonic() + seconds
        for attending in self._under_way:
            attending.join(max(0.0, deadline - time.monotonic()))


def _attend(child: subprocess.Popen[str], folder: Path) -> None:
    assert child.stderr is not None
    said = child.stderr.read().strip()  # not communicate(), which would close its standard input
    if child.wait():
        log.error("%s is not exported: %s", folder, said or f"its process ended with {child.returncode}")
