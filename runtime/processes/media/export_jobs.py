"""Export of closed episodes by a child process of lowest priority, for which nothing else waits."""

from __future__ import annotations

import logging
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path

log = logging.getLogger(__name__)
_LOOK_S = 0.02


class ExportQueue:
    """Queue of exports into one data folder, one at a time; its child process ends with this process.

    If `wanted` is False it does nothing.
    """

    def __init__(self, data: Path, wanted: bool = True) -> None:
        self._data = data
        self._wanted = wanted
        self._waiting: queue.Queue[Path] = queue.Queue()
        self._thread: threading.Thread | None = None

    def submit(self, folder: Path) -> None:
        """Queue the closed episode in `folder`; returns at once. Errors are logged."""
        if not self._wanted:
            return
        self._waiting.put(folder)
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="export", daemon=True)
            self._thread.start()

    def finish(self, seconds: float) -> None:
        """Wait for the queued exports, at most `seconds` [s].

        Exports that remain are made when they are requested again.
        """
        deadline = time.monotonic() + seconds
        while self._waiting.unfinished_tasks and time.monotonic() < deadline:
            time.sleep(_LOOK_S)

    def _work(self) -> None:
        while True:
            folder = self._waiting.get()
            try:
                self._export(folder)
            except OSError as error:
                log.error("%s is not exported: %s", folder, error)
            finally:
                self._waiting.task_done()

    def _export(self, folder: Path) -> None:
        child = subprocess.Popen(
            (
                sys.executable,
                "-m",
                "runtime.recording",
                "export",
                str(folder),
                "--to",
                str(self._data),
                "--background",
            ),
            stdin=subprocess.PIPE,  # the child ends when we close it
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert child.stderr is not None
        text = child.stderr.read().strip()  # communicate() would close its standard input, which ends it
        if child.wait():
            log.error("%s is not exported: %s", folder, text or f"its process exited with {child.returncode}")
