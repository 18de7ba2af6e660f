"""The journal's own thread: it alone waits for the disk, writes what has gathered, and syncs every file."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from runtime.core.errors import RecordingError
from runtime.recording.digests import FileDigest
from runtime.recording.files import AppendFile, DiskFullError, require_room, sync_folder
from runtime.recording.layout import Layout
from runtime.recording.settings import RecordingSettings
from runtime.recording.tables import SCHEMAS, TableWriter

MOST_WAITING = 16384  # records of one table in memory: 80 s of ticks at 200 Hz
_MANY = 1024  # from here on the thread does not wait for its period to end


class ErrorLatch:
    """The first error of any thread of a recording; kept until the caller has been told."""

    def __init__(self) -> None:
        self.first: RecordingError | None = None
        self.told = False

    def report(self, error: RecordingError) -> None:
        """Keep `error`, or note it on the one that came first."""
        if self.first is None:
            self.first = error
        elif error is not self.first:
            self.first.add_note(str(error))

    def clear_disk_full(self) -> None:
        """A full disk that nobody was told of has cost nothing yet: what it did not take is still held."""
        if isinstance(self.first, DiskFullError) and not self.told:
            self.first = None

    def raise_pending(self) -> None:
        """Raise what was reported, every time."""
        if self.first is not None:
            self.told = True
            raise RecordingError(str(self.first)) from self.first


class DiskWriter:
    """Tables and events of one episode, written and synced together with `others` every flush period."""

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
        self.full: DiskFullError | None = None  # why the end could not be written yet
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
        """Queue one record; RecordingError where the disk has not taken any for too long."""
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
        """Write and sync everything, what `others` have too, end the streams, close the files but those in `leave`.

        False where the disk has not done so by `deadline` (time.monotonic). Where it has no room `full` says so, the
        files stay open, and `save` tries again.
        """
        self._left, self._others = leave, others
        self._closing.set()
        self._wake.set()
        self._thread.join(max(0.0, deadline - time.monotonic()))
        return not self._thread.is_alive()

    def digests(self) -> dict[str, FileDigest]:
        """Of its own files, by name, once it has finished."""
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
        self._attempt(lambda: sync_folder(self._folder))  # the names of all files that begin created
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
        """Save what can be saved: one file that fails does not keep the others from being closed properly."""
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
        while self._unwritten_lines or self._lines:  # what was refused before, then what came since
            if not self._unwritten_lines:
                self._unwritten_lines = b"".join(self._lines.popleft() for _ in range(len(self._lines)))
            self._events.write(self._unwritten_lines, self._unwritten_lines.count(b"\n"))
            self._unwritten_lines = b""

    def _attempt(self, work: Callable[[], None], last: bool = False) -> None:
        """Report what goes wrong; at the last a disk without room is no loss yet."""
        try:
            work()
        except RecordingError as error:
            if last and isinstance(error, DiskFullError):
                self.full = self.full or error
            else:
                self._faults.report(error)
        except Exception as error:  # a record that no column takes, a descriptor that is gone: say so, go on
            self._faults.report(RecordingError(f"episode {self._folder}: {error!r}"))
