"""Writer thread of the journal, the only one that waits for the disk: it writes and syncs all files."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from runtime.core.durable_files import sync_folder
from runtime.core.errors import RecordingError
from runtime.recording.digests import FileDigest
from runtime.recording.files import AppendFile, DiskFullError, require_room
from runtime.recording.layout import Layout
from runtime.recording.settings import RecordingSettings
from runtime.recording.tables import SCHEMAS, TableWriter

MOST_WAITING = 16384  # records of one table in memory: 80 s of ticks at 200 Hz
_MANY = 1024  # from this many on, the thread does not wait for the end of its period


class ErrorLatch:
    """First error of any thread of a recording, stored until it is raised to the caller."""

    def __init__(self) -> None:
        self.first: RecordingError | None = None
        self.told = False

    def report(self, error: RecordingError) -> None:
        """Store `error`, or add it as a note to the first one."""
        if self.first is None:
            self.first = error
        elif error is not self.first:
            self.first.add_note(str(error))

    def clear_disk_full(self) -> None:
        """Remove the error of a full disk that was not raised yet.

        The refused bytes are still in memory, so no data are lost.
        """
        if isinstance(self.first, DiskFullError) and not self.told:
            self.first = None

    def raise_pending(self) -> None:
        """Raise the stored error, at every call."""
        if self.first is not None:
            self.told = True
            raise RecordingError(str(self.first)) from self.first


class DiskWriter:
    """Writer of the tables and events of one episode.

    Every flush period it syncs its files and `others`, which are files that other threads write.
    """

    def __init__(
        self,
        folder: Path,
        layout: Layout,
        settings: RecordingSettings,
        others: Sequence[AppendFile],
        faults: ErrorLatch,
    ) -> None:
        self._folder = folder
        self._settings = settings
        self._faults = faults
        self._closing = threading.Event()
        self._wake = threading.Event()
        self._lines: deque[bytes] = deque()
        self._unwritten_lines = b""
        self._left: Sequence[AppendFile] = ()
        self._others: Sequence[Callable[[], None]] = ()
        self._saved = False
        self.full: DiskFullError | None = None  # reason why the end could not be written yet
        self._tables: dict[str, TableWriter] = {}
        with ExitStack() as undo:
            self._events = AppendFile(folder / "events.jsonl")
            undo.callback(self._events.close)
            for name in SCHEMAS:
                self._tables[name] = TableWriter(folder, name, layout)
                undo.callback(self._tables[name].file.close)
            undo.pop_all()
        self._own = [self._events, *(table.file for table in self._tables.values())]
        self._files = [*self._own, *others]
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def add(self, table: str, record: object, patience: float = 0.0) -> None:
        """Queue one record; report a fault if too many records wait for the disk."""
        writer = self._tables[table]
        writer.add(record)
        if writer.waiting >= _MANY:
            self._wake.set()
            self._wait_for_room(writer, patience)

    def add_line(self, line: bytes) -> None:
        """Queue one line of events.jsonl."""
        self._lines.append(line + b"\n")

    def finish(
        self,
        deadline: float,
        leave: Sequence[AppendFile] = (),
        others: Sequence[Callable[[], None]] = (),
    ) -> bool:
        """Write and sync everything, end the streams, close all files except those in `leave`.

        If the disk is full, `full` is set and the files stay open; `save` then tries again.

        Args:
            deadline: Longest wait, as a time of time.monotonic.
            leave: Files that stay open.
            others: Functions that write other files; the writer's thread calls them at the end.

        Returns:
            True if the thread has ended by the deadline.
        """
        self._left, self._others = leave, others
        self._closing.set()
        self._wake.set()
        self._thread.join(max(0.0, deadline - time.monotonic()))
        return not self._thread.is_alive()

    def digests(self) -> dict[str, FileDigest]:
        """Return the digests of the writer's files by name, after it has finished."""
        return {file.path.name: file.digest for file in self._own}

    def _wait_for_room(self, writer: TableWriter, patience: float) -> None:
        deadline = time.monotonic() + patience
        while writer.waiting >= _MANY and time.monotonic() < deadline and self._faults.first is None:
            time.sleep(0.001)
        if writer.waiting >= MOST_WAITING:
            self._faults.report(
                RecordingError(
                    f"the disk does not keep up: {writer.waiting} records wait for {writer.file.path}"
                )
            )

    def _run(self) -> None:
        self._attempt(lambda: sync_folder(self._folder))  # make the names of the new files durable
        while not self._closing.is_set():
            self._wake.wait(self._settings.flush_period_s)
            self._wake.clear()
            if self._faults.first is None:
                self._attempt(self._flush)
        self.save()

    def _flush(self) -> None:
        self._write_lines()
        for table in self._tables.values():
            table.flush()
        self._sync()
        require_room(self._folder, self._settings.min_free_bytes)

    def save(self) -> None:
        """Save as much as possible: a file that fails does not prevent the rest from being closed properly."""
        if self._saved:
            return
        self.full = None
        tables, syncs = [table.finish for table in self._tables.values()], [file.sync for file in self._files]
        for work in (*self._others, self._write_lines, *tables, *syncs):
            self._attempt(work, last=True)
        if self.full is None:
            self._saved = True
            for file in self._files:
                if file not in self._left:
                    self._attempt(file.close)

    def _sync(self) -> None:
        for file in self._files:
            file.sync()

    def _write_lines(self) -> None:
        while (
            self._unwritten_lines or self._lines
        ):  # first the lines that were refused before, then newer ones
            if not self._unwritten_lines:
                self._unwritten_lines = b"".join(self._lines.popleft() for _ in range(len(self._lines)))
            self._events.write(self._unwritten_lines, self._unwritten_lines.count(b"\n"))
            self._unwritten_lines = b""

    def _attempt(self, work: Callable[[], None], last: bool = False) -> None:
        """Run `work` and report its error.

        With `last`, a full disk is stored in `full` instead, because no data are lost yet.
        """
        try:
            work()
        except RecordingError as error:
            if last and isinstance(error, DiskFullError):
                self.full = self.full or error
            else:
                self._faults.report(error)
        except Exception as error:  # unexpected errors, too, must be reported without ending the thread
            self._faults.report(RecordingError(f"episode {self._folder}: {error!r}"))
