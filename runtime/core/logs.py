"""Logging to standard error through a thread, so that a blocked terminal never blocks the caller."""

from __future__ import annotations

import logging
import os
import sys
import threading
from queue import SimpleQueue
from types import TracebackType

LINES_KEPT = 1000
_AT_EXIT_S = 1.0  # [s] for the remaining lines when the process ends
_STDERR = 2
_STACK_BYTES = 256 * 1024  # small, because control locks its memory


def configure_logging(process: str) -> None:
    """Log to standard error: time, process, level, message. EVA_LOG_LEVEL is the lowest level."""
    lines = NonBlockingHandler(_STDERR)
    lines.setFormatter(
        logging.Formatter(f"%(asctime)s {process:<10} %(levelname)-7s %(message)s", "%H:%M:%S")
    )
    logging.basicConfig(level=os.environ.get("EVA_LOG_LEVEL", "INFO"), handlers=[lines], force=True)
    sys.excepthook = _log_uncaught


class NonBlockingHandler(logging.Handler):
    """Log handler with a thread that writes lines to a descriptor.

    If the descriptor blocks (a stopped terminal, a pager, a pipe without a reader), lines beyond LINES_KEPT are dropped
    and counted; callers never wait, except at most a second at the end of the process. Writes bypass Python's buffers,
    whose locks a blocked writer would hold forever.
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._queue: SimpleQueue[bytes | threading.Event] = SimpleQueue()
        self._dropped = 0
        before = threading.stack_size(_STACK_BYTES)
        threading.Thread(target=self._write, name="log", daemon=True).start()
        threading.stack_size(before)

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the line, without I/O and without a lock that the writing thread could hold."""
        if self._queue.qsize() >= LINES_KEPT:
            self._dropped += 1
            return
        try:
            self._queue.put(f"{self.format(record)}\n".encode(errors="backslashreplace"))
        except (TypeError, ValueError, LookupError) as error:  # the format string is wrong
            self._queue.put(f"{record.pathname}:{record.lineno}: cannot be logged: {error}\n".encode())

    def flush(self) -> None:
        """Wait at most a second until everything is written; `logging` calls it when the process ends."""
        written = threading.Event()
        self._queue.put(written)
        written.wait(_AT_EXIT_S)

    def _write(self) -> None:
        while True:
            line = self._queue.get()
            if isinstance(line, threading.Event):
                line.set()
                continue
            dropped, self._dropped = self._dropped, 0
            if dropped:
                line = f"({dropped} lines were dropped: not read in time)\n".encode() + line
            self._put(line)

    def _put(self, line: bytes) -> None:
        try:
            while line:
                line = line[os.write(self._descriptor, line) :]
        except OSError:
            self._dropped += 1  # the terminal is gone, and may come back


def _log_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Log the exception that ends the process, because its traceback must not wait for a terminal either."""
    if issubclass(kind, Exception):
        logging.getLogger(__name__).critical("this process ends", exc_info=(kind, error, trace))
    else:
        sys.__excepthook__(kind, error, trace)
