"""Journal of an episode: rows, ticks, chunks, events and pictures, written to one folder while they happen."""

from __future__ import annotations

import fcntl
import math
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from runtime.core.durable_files import sync_folder
from runtime.core.errors import RecordingError
from runtime.ipc.messages import ExecutedTick
from runtime.recording.admission import admit_chunk, admit_row, admit_tick
from runtime.recording.base import (
    VIDEO_LOST,
    Journal,
    LostCamera,
    Outcome,
    RawChunk,
    Record,
    Row,
)
from runtime.recording.columns import RecordedRow
from runtime.recording.digests import FileDigest
from runtime.recording.encoder import CameraEncoder
from runtime.recording.files import (
    DiskFullError,
    UnclosedError,
    disk_error,
    require_room,
    to_json,
    write_atomic,
)
from runtime.recording.fragments import count_frames
from runtime.recording.layout import Layout
from runtime.recording.outcome_seal import (
    MANIFEST,
    digest_of,
    digests_of,
    seal_outcome,
    write_outcome,
)
from runtime.recording.settings import RecordingSettings
from runtime.recording.summary import summarise
from runtime.recording.tables import read_table, rows_schema
from runtime.recording.writer import DiskWriter, ErrorLatch

_LEAST_DISK_SECONDS = 1.0  # time for the last writes [s]
_PATIENCE = 6.0  # factor of the drain timeout in lockstep, which loses nothing to a busy machine


class EpisodeJournal(Journal):
    """Journal that writes `root`/<uuid>/, one episode after the other; one thread appends.

    A picture that is missing, or for which an encoder has no time, becomes a flagged repeat, so that `append` never
    waits for an encoder. With `patient` (lockstep has no deadline) it waits for a free place and for the end of
    encoders, long enough to distinguish a slow encoder from one that never ends. An encoder that fails, or whose file
    cannot be written, costs the video of its camera: `pop_lost_cameras` names it, and the recording continues. Pictures
    are passed without a copy: they must no longer change.
    """

    def __init__(
        self, root: Path, settings: RecordingSettings | None = None, *, patient: bool = False
    ) -> None:
        self._root = root
        self._settings = settings or RecordingSettings()
        self._patience = _PATIENCE * self._settings.drain_timeout_s if patient else 0.0
        self._recording: _Recording | None = None
        self._losses: list[LostCamera] = []

    @property
    def folder(self) -> Path | None:
        """Folder of the episode that is being recorded."""
        return self._recording.folder if self._recording else None

    def begin(self, manifest: Mapping[str, object]) -> None:
        if self._recording is not None:
            raise RecordingError(f"episode {self._recording.folder} has not ended, a second one cannot begin")
        layout = Layout.from_manifest(manifest)
        text = to_json(manifest, "the manifest", indent=1)
        require_room(self._root, self._settings.min_free_bytes)
        folder = _create(self._root, layout.uuid)
        try:
            write_atomic(folder / MANIFEST, text)
            recording = _Recording(folder, layout, self._settings, self._patience)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)  # the folder is ours and has no rows yet
            raise
        self._recording = recording
        self._losses = []

    def append(self, record: Record) -> None:
        self._begun().append(record)

    def append_event(self, event: Mapping[str, object]) -> None:
        self._begun().mark(event)

    def pop_lost_cameras(self) -> Sequence[LostCamera]:
        if self._recording is not None:
            self._losses += self._recording.pop_lost_cameras()
        losses, self._losses = self._losses, []
        return losses

    def end(self, outcome: Outcome) -> None:
        """Write all waiting records, close every file, and write the outcome last.

        Measured figures (frames, duration_s, ...) replace those of `outcome.details`. An error of a thread makes the
        status "failed"; it is raised after everything else was saved, unless `append` has raised it already. Raises
        UnclosedError if the disk has no room for the end: no data are lost, and the end can be written again later.
        """
        recording, self._recording = self._begun(), None
        try:
            recording.end(outcome)
        finally:
            self._losses += recording.pop_lost_cameras()

    def _begun(self) -> _Recording:
        if self._recording is None:
            raise RecordingError(f"no episode has begun in {self._root}")
        return self._recording


def _create(root: Path, name: str) -> Path:
    folder = root / name
    try:
        root.mkdir(parents=True, exist_ok=True)
        if folder.exists():
            raise RecordingError(f"episode {folder} exists already; an episode is never written twice")
        folder.mkdir()
        sync_folder(root)
    except OSError as error:
        raise disk_error("creating", folder, error) from error
    return folder


def lock_folder(folder: Path) -> int | None:
    """Return a descriptor that locks `folder` for writing until it is closed; None if another process has locked it.

    The kernel releases the lock however the process ends.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise disk_error("opening", folder, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except OSError as error:
        os.close(descriptor)
        raise disk_error("locking", folder, error) from error
    return descriptor


def _locked(folder: Path) -> int:
    descriptor = lock_folder(folder)
    if descriptor is None:
        raise RecordingError(f"episode {folder} is being written by another process")
    return descriptor


class _Recording:
    """One episode between `begin` and `end`."""

    def __init__(self, folder: Path, layout: Layout, settings: RecordingSettings, patience: float) -> None:
        self.folder = folder
        self._layout = layout
        self._settings = settings
        self._patience = patience
        self._rows = 0
        self._newest = layout.started  # time of the newest row [s], on the clock of the rows
        self._faults = ErrorLatch()
        self._lost: dict[str, LostCamera] = {}
        self._told = 0
        self._ending = False
        self._encoders: dict[str, CameraEncoder] = {}
        with ExitStack() as undo:
            self._lock = _locked(folder)
            undo.callback(os.close, self._lock)
            for camera, size in layout.cameras.items():
                path = folder / f"{camera}.mp4"
                encoder = CameraEncoder(camera, path, size, layout.fps, settings)
                self._encoders[camera] = encoder
                undo.callback(encoder.cancel)
            files = [encoder.file for encoder in self._encoders.values()]
            self._writer = DiskWriter(folder, layout, settings, files, self._faults)
            undo.pop_all()

    def append(self, record: Record) -> None:
        self._raise_pending()
        if isinstance(record, Row):
            self._append_row(record)
        elif isinstance(record, ExecutedTick):
            tick = admit_tick(self._layout, record)
            self._writer.add("ticks", tick, self._patience)
            if tick.smoothed is not None:
                self._writer.add("smoothed", tick, self._patience)
        elif isinstance(record, RawChunk):
            chunk = admit_chunk(record)
            if chunk.actions.size:
                self._writer.add("raw", chunk, self._patience)
        else:
            raise RecordingError(
                f"a journal takes Row, ExecutedTick and RawChunk, not {type(record).__name__}"
            )

    def _append_row(self, row: Row) -> None:
        # The check comes first: a refused row must not leave a frame in the videos.
        admitted = admit_row(self._layout, row, self._rows)
        repeated = {
            camera
            for camera, encoder in self._encoders.items()
            if not encoder.put(row.pictures[camera], self._patience, self._capture_time(row, camera))
        }
        self._rows += 1
        self._newest = row.tick_time
        unseen = {camera for camera in repeated if row.pictures[camera] is not None}
        lost = row.lost | unseen | self._lost.keys()
        self._writer.add("rows", RecordedRow(admitted, frozenset(repeated), frozenset(lost)), self._patience)

    def _capture_time(self, row: Row, camera: str) -> float:
        """Return the capture time of the picture; NaN in lockstep, because encoders use another clock there."""
        return math.nan if self._patience else row.captured.get(camera, math.nan)

    def mark(self, event: Mapping[str, object]) -> None:
        self._raise_pending()
        self._writer.add_line(to_json(event, "an event"))

    def pop_lost_cameras(self) -> list[LostCamera]:
        """Return the cameras that have been lost since the last call."""
        new = list(self._lost.values())[self._told :]
        self._told += len(new)
        return new

    def end(self, outcome: Outcome) -> None:
        drain_s = max(self._settings.drain_timeout_s, self._patience)
        deadline = time.monotonic() + drain_s
        self._ending = True
        stuck = self._drain(deadline)
        # A deadline of its own, even if the encoders used theirs up: without an outcome the episode needs a repair.
        last = time.monotonic() + max(drain_s, _LEAST_DISK_SECONDS)
        ended = [encoder for encoder in self._encoders.values() if encoder not in stuck]
        if not self._writer.finish(
            last, leave=[encoder.file for encoder in stuck], others=[encoder.save for encoder in ended]
        ):
            self._faults.report(
                RecordingError(f"the disk did not take the end of episode {self.folder} in time")
            )
            self._faults.raise_pending()
        self._faults.clear_disk_full()
        self._conclude(outcome, stuck)

    def _conclude(self, outcome: Outcome, stuck: Sequence[CameraEncoder]) -> None:
        """Write the outcome, with digests of all files but those of the encoders `stuck`.

        Raises UnclosedError, with the folder still locked, if the disk has no room.
        """
        full: DiskFullError | None = self._writer.full
        try:
            if full is None:
                self._report_losses()
                write_outcome(self.folder, seal_outcome(self._conclusion(outcome), self._digests(stuck)))
        except DiskFullError as error:
            full = error
        finally:
            if full is None and not stuck:  # a stuck encoder may still write: locked until the process ends
                os.close(self._lock)
        if full is not None:
            raise UnclosedError(str(full), lambda: self._conclude_again(outcome, stuck)) from full
        if not self._faults.told:
            self._faults.raise_pending()

    def _conclude_again(self, outcome: Outcome, stuck: Sequence[CameraEncoder]) -> None:
        self._writer.save()
        self._conclude(outcome, stuck)

    def _report_losses(self) -> None:
        """Report an error for each encoder that dropped pictures because the disk was full, even if there is room
        again.
        """
        for encoder in self._encoders.values():
            if isinstance(encoder.failure, DiskFullError):
                self._faults.report(encoder.failure)

    def _drain(self, deadline: float) -> list[CameraEncoder]:
        """End all encoders; return those that did not end in time."""
        for encoder in self._encoders.values():
            encoder.finish()
        stuck = [encoder for encoder in self._encoders.values() if not encoder.drain(deadline)]
        for encoder in stuck:
            encoder.abandon()
        self._check_encoders()
        return stuck

    def _conclusion(self, outcome: Outcome) -> dict[str, object]:
        rows = self._rows
        status, reason, fault = outcome.status, outcome.reason, self._faults.first
        if fault is not None:
            table = read_table(self.folder / "rows.arrow", rows_schema(self._layout))
            rows, status = table.table.num_rows, "failed"
            reason = reason if str(fault) in reason else "; ".join(filter(None, (reason, str(fault))))
        videos = {
            camera: encoder.frames if encoder.failure is None else count_frames(encoder.path)
            for camera, encoder in self._encoders.items()
        }
        lost = [replace(loss, row=videos[camera]) for camera, loss in self._lost.items()]
        frames = min([rows, *(count for camera, count in videos.items() if camera not in self._lost)])
        summary = summarise(self.folder / "rows.arrow", self._layout, frames)
        return {
            **outcome.details,
            "status": status,
            "reason": "; ".join(filter(None, (reason, *(loss.text for loss in lost)))),
            "ended_wall": outcome.ended_wall,
            **summary.to_dict(),
            "rows": rows,
            "video_frames": videos,
            "lost_cameras": {loss.camera: {"row": loss.row, "reason": loss.reason} for loss in lost},
            "muxed_ms": {camera: encoder.muxed_ms for camera, encoder in self._encoders.items()},
        }

    def _digests(self, stuck: Sequence[CameraEncoder]) -> dict[str, FileDigest]:
        """Return the digests of the written files, except those that the encoders `stuck` may still write.

        After a fault the files are read back from the disk.
        """
        if self._faults.first is not None:
            digests = digests_of(self.folder, self._layout)
        else:
            digests = {MANIFEST: digest_of(self.folder / MANIFEST, self._layout), **self._writer.digests()}
            for camera, encoder in self._encoders.items():
                lies = digest_of(encoder.path, self._layout) if camera in self._lost else encoder.file.digest
                digests[encoder.path.name] = lies
        for encoder in stuck:
            digests.pop(encoder.path.name, None)
        return digests

    def _raise_pending(self) -> None:
        self._check_encoders()
        self._faults.raise_pending()

    def _check_encoders(self) -> None:
        """Check for failed encoders: a full disk ends the recording, any other failure only the video of its camera."""
        for camera, encoder in self._encoders.items():
            failure = encoder.failure
            if isinstance(failure, DiskFullError):
                if not self._ending:  # at the end, its bytes are written with all others
                    self._faults.report(failure)
            elif failure is not None and camera not in self._lost:
                loss = self._lost[camera] = LostCamera(camera, encoder.frames, str(failure))
                event = {"camera": camera, "row": loss.row}
                fields = {
                    "kind": VIDEO_LOST,
                    "text": loss.text,
                    "time": self._newest,
                    "step": -1,
                    "data": event,
                }
                self._writer.add_line(to_json(fields, "an event"))
