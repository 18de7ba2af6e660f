"""Reader of our own recorded episodes for the quality checks; rows are read batch by batch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from robots import RobotError
from runtime.core.errors import RecordingError
from runtime.quality.block import (
    BLOCK_ROWS,
    Block,
    Bools,
    EpisodeSource,
    JointSpecs,
    Vector,
    VectorColumn,
    VideoEnd,
    known_joints,
    unknown_joints,
)
from runtime.quality.frame_stream import FrameStream, VideoFrameStream
from runtime.quality.report import Severity
from runtime.recording.files import read_json
from runtime.recording.layout import Layout, simulated_bench
from runtime.recording.outcome_seal import DIGESTS, OUTCOME, read_outcome
from runtime.recording.scrub import verify_episode
from runtime.recording.tables import added, rows_schema

_ROLES = {"qpos": "state", "action": "action", "eef": "poses", "eef_action": "poses"}
_SPARSE = ("qvel", "effort")  # columns that some robots fill only in some rows


class JournalSource(EpisodeSource):
    """Source of the checks for an episode in a folder DATA/episodes/UUID.

    Raises RecordingError if its manifest cannot be read.
    """

    started = "tick_time"

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._manifest = read_json(folder / "manifest.json")
        self._layout = Layout.from_manifest(self._manifest)
        self._robot = _table(self._manifest, "robot")
        self.name = self._layout.uuid
        self.fps = self._layout.fps
        self.ends: dict[str, VideoEnd] = {}
        self.frames, self.remarks = self._outcome()
        self.cameras = dict(self._layout.cameras)
        self.schema = _table(self._manifest, "collection")
        self.drawn = bool(simulated_bench(self._manifest))
        self.vectors = {name: self._vector(name) for name in ("qpos", "action", *self._layout.streams)}

    def _outcome(self) -> tuple[int | None, list[tuple[str, Severity, str]]]:
        """Return the expected number of rows, and findings about the end of the recording."""
        path = self._folder / OUTCOME
        if not path.exists():
            return None, [("unfinished", "error", "it has no outcome: it is being recorded, or wants repair")]
        try:
            outcome = read_outcome(self._folder)
        except RecordingError as error:
            return None, [("unfinished", "error", str(error))]
        remarks: list[tuple[str, Severity, str]] = []
        if DIGESTS in outcome:  # without digests, unreadable files are found later
            remarks += [("damaged", "error", damage.text) for damage in verify_episode(self._folder).damage]
        status, reason = outcome.get("status"), outcome.get("reason", "")
        if status == "failed":
            remarks.append(("recording_failed", "error", f"the recording failed: {reason}"))
        elif status == "interrupted":
            remarks.append(("interrupted", "info", f"the run was interrupted: {reason}"))
        cut = _table(outcome, "repair").get("rows_cut")
        if isinstance(cut, int) and cut > 0:
            remarks.append(
                ("rows_cut", "warning", f"repair cut {cut} rows that had no picture of every camera")
            )
        for camera, fields in _table(outcome, "lost_cameras").items():
            row = fields.get("row") if isinstance(fields, Mapping) else None
            if isinstance(row, bool) or not isinstance(row, int) or row < 0:
                text = f"{path}: lost_cameras.{camera} is {fields!r}, must be a table with a row from 0"
                remarks.append(("unfinished", "error", text))
            else:
                self.ends[camera] = VideoEnd(row, str(fields.get("reason", "")))
        frames = outcome.get("frames")
        if isinstance(frames, bool) or not isinstance(frames, int) or frames < 0:
            remarks.append(
                ("unfinished", "error", f"{path}: frames is {frames!r}, must be a whole number from 0")
            )
            return None, remarks
        return frames, remarks

    def _vector(self, name: str) -> Vector:
        width = self._layout.width(name)
        names = self._robot.get("eef_names" if name.startswith("eef") else "joint_names")
        labels = tuple(map(str, names)) if isinstance(names, list) else ()
        labels = labels if len(labels) == width else tuple(f"number {k}" for k in range(width))
        return Vector(width, labels, _ROLES.get(name, "other"), name in _SPARSE)

    def blocks(self) -> Iterator[Block]:
        path = self._folder / "rows.arrow"
        left = self.frames
        first = 0
        try:
            with pa.OSFile(str(path)) as file:
                batches = pa.ipc.open_stream(file)
                _require(path, batches.schema, rows_schema(self._layout))
                while left is None or left > 0:
                    batch = _next(batches, path, self.frames, first)
                    if batch is None:
                        return
                    batch = batch if left is None else batch.slice(0, left)
                    for start in range(
                        0, batch.num_rows, BLOCK_ROWS
                    ):  # a patient recorder writes long batches
                        part = batch.slice(start, BLOCK_ROWS)
                        yield self._block(part, first)
                        first += part.num_rows
                    left = None if left is None else left - batch.num_rows
        except (OSError, pa.ArrowException) as error:
            raise RecordingError(f"{path} cannot be read on after row {first - 1}: {error}") from error

    def _block(self, batch: Any, first: int) -> Block:
        layout = self._layout
        stored = set(batch.schema.names)
        return Block(
            first=first,
            rows=batch.num_rows,
            index=batch.column("index").to_numpy(),
            clocks={"tick_time": numbers(batch.column("tick_time"))},
            vectors={name: fixed(batch.column(name), vector.width) for name, vector in self.vectors.items()},
            captured={
                stream: numbers(batch.column(f"capture_time.{stream}")) for stream in layout.capture_streams
            },
            repeated={camera: marks(batch, f"repeated.{camera}") for camera in layout.cameras},
            lost={
                camera: marks(batch, f"lost.{camera}")
                for camera in layout.cameras
                if f"lost.{camera}" in stored
            },
            simulated=np.array(
                [source == "sim" for source in batch.column("control_source").to_pylist()], np.bool_
            )
            if "control_source" in stored
            else None,
        )

    def open_frames(self, camera: str, sampling: int) -> FrameStream:
        return VideoFrameStream(self._folder / f"{camera}.mp4", sampling)

    def joints(self) -> tuple[JointSpecs | None, str]:
        names = self.vectors["qpos"].names
        settings = _table(self._manifest, "configuration")
        try:
            return known_joints(str(settings.get("robot") or self._robot.get("name", "")), names), ""
        except RobotError as error:
            return unknown_joints(names), f"limits are not checked: {error}"


def fixed(column: Any, width: int) -> VectorColumn:
    """Return a column of lists of `width` values as arrays; rows that are null count as missing."""
    missing = ~np.asarray(column.is_valid().to_numpy(zero_copy_only=False), np.bool_)
    values = np.zeros((len(column), width), np.float32)
    values[~missing] = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
    return VectorColumn(values, missing, np.zeros(len(column), np.bool_))


def numbers(column: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return a column of numbers as float64 [N], NaN for null."""
    return np.asarray(column.to_numpy(zero_copy_only=False), np.float64)


def marks(batch: Any, name: str) -> Bools:
    """Return a column of flags [N]."""
    return np.asarray(batch.column(name).fill_null(False).to_numpy(zero_copy_only=False), np.bool_)


def _next(batches: Any, path: Path, frames: int | None, first: int) -> Any:
    try:
        return batches.read_next_batch()
    except StopIteration:
        if frames is not None:
            raise RecordingError(f"{path} holds {first} rows, its outcome says {frames}") from None
        return None


def _require(path: Path, actual: Any, expected: Any) -> None:
    """Check that each column of the manifest exists with its declared type. Raises RecordingError."""
    strange = [
        f"{field.name} is {actual.field(field.name).type if field.name in actual.names else 'absent'}, "
        f"must be {field.type}"
        for field in expected
        if (
            actual.field(field.name).type != field.type
            if field.name in actual.names
            else not added(field.name)
        )
    ]
    if strange:
        raise RecordingError(f"{path} has other columns than its manifest says: {'; '.join(strange)}")


def _table(table: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = table.get(key)
    return dict(value) if isinstance(value, Mapping) else {}
