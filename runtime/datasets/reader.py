"""Reads episodes of LeRobot v2.0 and v2.1 datasets, whatever their columns are called."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.datasets import layout
from runtime.datasets.mapping import ColumnMapping, video_key
from runtime.datasets.pictures import Pictures
from runtime.errors import RecordingError
from runtime.types import Float32, Float64

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class EpisodeEntry:
    """One line of meta/episodes.jsonl."""

    index: int
    length: int  # rows
    tasks: tuple[str, ...]
    file_stem: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RecordedEpisode:
    """One episode in memory, but for its pictures; row k of an array and frame k of a video belong together.

    float32 `qpos`, `qvel`, `effort`, `action` [N, D] and `eef`, `action_eef` [N, 8 * arms] as stored, None
    where the mapping names no column; `timestamps` float64 [N] s from the episode's start; `captured` capture
    times float64 [N] s by stream.
    """

    index: int
    fps: float
    task: str
    timestamps: Float64
    qpos: Float32
    action: Float32 | None
    eef: Float32 | None
    qvel: Float32 | None
    effort: Float32 | None
    action_eef: Float32 | None
    captured: Mapping[str, Float64]
    videos: Mapping[str, Path]  # by camera key

    @property
    def length(self) -> int:
        """Rows, and pictures per camera."""
        return len(self.qpos)

    def pictures(self, camera: str) -> Pictures:
        """The pictures of one camera; raises RecordingError where its video is absent or too short."""
        if camera not in self.videos:
            raise RecordingError(
                f"episode {self.index} has no video for camera {camera!r}, there are {sorted(self.videos)}"
            )
        pictures = Pictures(self.videos[camera])
        if len(pictures) < self.length:
            frames = len(pictures)
            pictures.close()
            raise RecordingError(f"{self.videos[camera]} has {frames} frames for {self.length} rows")
        return pictures


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """An opened dataset: its metadata in memory, its episodes on disk."""

    root: Path
    info: Mapping[str, Any]
    fps: float
    episodes: tuple[EpisodeEntry, ...]
    tasks: Mapping[int, str]

    @property
    def features(self) -> Mapping[str, Mapping[str, Any]]:
        """The declared features by key."""
        features: Mapping[str, Mapping[str, Any]] = self.info["features"]
        return features

    def entry(self, index: int) -> EpisodeEntry:
        """The entry of episode `index`; raises RecordingError naming the episodes there are."""
        for entry in self.episodes:
            if entry.index == index:
                return entry
        there = f"{self.episodes[0].index} to {self.episodes[-1].index}" if self.episodes else "none"
        raise RecordingError(f"{self.root} has no episode {index}, there are {len(self.episodes)}: {there}")

    def episode(self, index: int, mapping: ColumnMapping | None = None) -> RecordedEpisode:
        """Episode `index` with its columns as `mapping` names them; raises RecordingError."""
        mapping = mapping or ColumnMapping()
        entry = self.entry(index)
        table = self._table(entry)
        columns = _Columns(table, layout.data_file(self.root, self.info, index, entry.file_stem))
        return RecordedEpisode(
            index=index,
            fps=self.fps,
            task=self._task(entry, columns),
            timestamps=self._timestamps(columns),
            qpos=columns.vectors(mapping.state),
            action=columns.optional(mapping.action),
            eef=columns.optional(mapping.eef),
            qvel=columns.optional(mapping.velocity),
            effort=columns.optional(mapping.effort),
            action_eef=columns.optional(mapping.action_eef),
            captured={stream: columns.scalars(name) for stream, name in mapping.capture_time.items()},
            videos=self._videos(entry, mapping),
        )

    def _table(self, entry: EpisodeEntry) -> pa.Table:
        import pyarrow as pa
        import pyarrow.parquet as pq

        path = layout.data_file(self.root, self.info, entry.index, entry.file_stem)
        if not path.is_file():
            raise RecordingError(f"{self.root} lists episode {entry.index} but there is no {path}")
        try:
            table = pq.ParquetFile(path).read()
        except (OSError, pa.ArrowException) as error:
            raise RecordingError(f"{path} cannot be read: {error}") from error
        if table.num_rows != entry.length or not table.num_rows:
            raise RecordingError(f"{path} has {table.num_rows} rows, {layout.EPISODES} says {entry.length}")
        return table

    def _task(self, entry: EpisodeEntry, columns: _Columns) -> str:
        if columns.has("task_index"):
            number = int(columns.scalars("task_index")[0])
            if number in self.tasks:
                return self.tasks[number]
        return entry.tasks[0] if entry.tasks else ""

    def _timestamps(self, columns: _Columns) -> Float64:
        if columns.has("timestamp"):
            return columns.scalars("timestamp")
        return np.arange(columns.rows, dtype=np.float64) / self.fps

    def _videos(self, entry: EpisodeEntry, mapping: ColumnMapping) -> dict[str, Path]:
        stored = layout.video_keys(self.features)
        prefix = video_key("")
        wanted = mapping.videos
        if wanted is None:
            wanted = {key.removeprefix(prefix): key for key in stored if key.startswith(prefix)}
        for camera, key in wanted.items():
            if key not in stored:
                raise RecordingError(
                    f"{self.root} has no video {key!r} for camera {camera!r}, there are {sorted(stored)}"
                )
        return {
            camera: layout.video_file(self.root, self.info, key, entry.index, entry.file_stem)
            for camera, key in wanted.items()
        }


class _Columns:
    """The columns of one episode's table as arrays; errors name the file and the columns there are."""

    def __init__(self, table: pa.Table, path: Path) -> None:
        self._table = table
        self._path = path
        self.rows: int = table.num_rows

    def has(self, name: str) -> bool:
        return name in self._table.column_names

    def optional(self, name: str | None) -> Float32 | None:
        return None if name is None else self.vectors(name)

    def vectors(self, name: str) -> Float32:
        """Column `name` as float32 [N, W], read-only."""
        rows = np.ascontiguousarray(self._flat(name), dtype=np.float32).reshape(self.rows, -1)
        rows.flags.writeable = False
        return rows

    def scalars(self, name: str) -> Float64:
        """Column `name` as float64 [N]."""
        flat = self._flat(name)
        if flat.size != self.rows:
            raise RecordingError(f"{self._path}: column {name!r} holds vectors, expected one number per row")
        return np.asarray(flat, dtype=np.float64)

    def _flat(self, name: str) -> np.ndarray[Any, Any]:
        import pyarrow as pa

        if not self.has(name):
            raise RecordingError(f"{self._path} has no column {name!r}, there are {self._table.column_names}")
        column = self._table.column(name).combine_chunks()
        if column.null_count:
            raise RecordingError(f"{self._path}: column {name!r} has {column.null_count} empty rows")
        if pa.types.is_list(column.type) or pa.types.is_large_list(column.type):
            lengths = set(column.value_lengths().to_pylist())
            if len(lengths) > 1:
                raise RecordingError(f"{self._path}: rows of column {name!r} have lengths {sorted(lengths)}")
            column = column.flatten()
        elif pa.types.is_fixed_size_list(column.type):
            column = column.flatten()
        if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
            raise RecordingError(f"{self._path}: column {name!r} is {column.type}, expected numbers")
        return np.asarray(column.to_numpy(zero_copy_only=False))


def open_dataset(root: Path | str) -> Dataset:
    """Open the LeRobot v2.0 or v2.1 dataset in `root`; raises RecordingError saying what is there instead."""
    root = Path(root)
    if not root.is_dir():
        raise RecordingError(f"there is no dataset folder {root}")
    info = layout.read_info(root)
    entries = (_entry(root, line) for line in layout.read_lines(root / layout.EPISODES))
    return Dataset(
        root=root,
        info=info,
        fps=float(info["fps"]),
        episodes=tuple(
            sorted((e for e in entries if e.index < info["total_episodes"]), key=lambda entry: entry.index)
        ),
        tasks={int(line["task_index"]): str(line["task"]) for line in layout.read_lines(root / layout.TASKS)},
    )


def _entry(root: Path, line: Mapping[str, Any]) -> EpisodeEntry:
    try:
        return EpisodeEntry(
            index=int(line["episode_index"]),
            length=int(line["length"]),
            tasks=tuple(str(task) for task in line.get("tasks", ())),
            file_stem=line.get("file_stem"),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{root / layout.EPISODES}: {dict(line)} is no episode: {error!r}") from error
