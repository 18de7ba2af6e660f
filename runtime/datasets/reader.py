"""Reader of episodes of LeRobot v2.0, v2.1 and v3.0 datasets, with any names of columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.types import Float32, Float64
from runtime.datasets import layout
from runtime.datasets.entries import EpisodeEntry, Span, entry, episode_lines, task_lines
from runtime.datasets.mapping import ColumnMapping, video_key
from runtime.datasets.rows import read_rows
from runtime.datasets.video_frames import (
    ImageSequence,
    StoredImages,
    VideoFrames,
    VideoSegment,
)

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True, eq=False)
class RecordedEpisode:
    """One episode in memory, except its images; row k of an array belongs to frame k of a video.

    `qpos`, `qvel`, `effort` and `action` are float32 [N, D], `eef` and `action_eef` float32 [N, 8 * arms], all as
    stored; each except `qpos` is None if the mapping names no column for it. `timestamps` float64 [N] are seconds from
    the episode's start. `captured` has for each stream the capture times float64 [N] [s].
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
    videos: Mapping[str, Span]  # by camera key
    images: Mapping[str, StoredImages]  # by camera key: images stored in columns

    @property
    def length(self) -> int:
        """Number of rows, and of images per camera."""
        return len(self.qpos)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Keys of the cameras with images."""
        return (*self.videos, *self.images)

    def pictures(self, camera: str) -> ImageSequence:
        """Open the images of one camera. Raises: RecordingError if its video is absent or too short."""
        if camera in self.images:
            return self.images[camera]
        if camera not in self.videos:
            raise RecordingError(
                f"episode {self.index} has no pictures of camera {camera!r}, there are {sorted(self.cameras)}"
            )
        span = self.videos[camera]
        if span.start is not None:
            return VideoFrames(span.path, VideoSegment(span.start, self.length, self.fps))
        pictures = VideoFrames(span.path)
        if len(pictures) < self.length:
            frames = len(pictures)
            pictures.close()
            raise RecordingError(f"{span.path} has {frames} frames for {self.length} rows")
        return pictures


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """Opened dataset: its metadata in memory, its episodes on disk."""

    root: Path
    info: Mapping[str, Any]
    fps: float
    episodes: tuple[EpisodeEntry, ...]
    tasks: Mapping[int, str]

    @property
    def version(self) -> str:
        """Version of the format."""
        return str(self.info["codebase_version"])

    @property
    def features(self) -> Mapping[str, Mapping[str, Any]]:
        """Declared features by key."""
        features: Mapping[str, Mapping[str, Any]] = self.info["features"]
        return features

    def entry(self, index: int) -> EpisodeEntry:
        """Return the entry of episode `index`. Raises: RecordingError naming the existing episodes."""
        for listed in self.episodes:
            if listed.index == index:
                return listed
        available = f"{self.episodes[0].index} to {self.episodes[-1].index}" if self.episodes else "none"
        raise RecordingError(
            f"{self.root} has no episode {index}, there are {len(self.episodes)}: {available}"
        )

    def episode(self, index: int, mapping: ColumnMapping | None = None) -> RecordedEpisode:
        """Read episode `index` with the columns that `mapping` names. Raises: RecordingError."""
        mapping = mapping or ColumnMapping()
        listed = self.entry(index)
        cameras = self._cameras(mapping)
        images = {camera: key for camera, key in cameras.items() if key not in listed.videos}
        columns = _Columns(self._table(listed, set(images.values())), listed.data)
        return RecordedEpisode(
            index=index,
            fps=self.fps,
            task=self._task(listed, columns),
            timestamps=self._timestamps(columns),
            qpos=columns.vectors(mapping.state),
            action=columns.optional(mapping.action),
            eef=columns.optional(mapping.eef),
            qvel=columns.optional(mapping.velocity),
            effort=columns.optional(mapping.effort),
            action_eef=columns.optional(mapping.action_eef),
            captured={stream: columns.scalars(name) for stream, name in mapping.capture_time.items()},
            videos={camera: listed.videos[key] for camera, key in cameras.items() if camera not in images},
            images={camera: columns.images(key, self.root) for camera, key in images.items()},
        )

    def table(self, index: int) -> pa.Table:
        """Return all columns of episode `index` as stored. Raises: RecordingError."""
        return self._table(self.entry(index), set(layout.image_keys(self.features)))

    def _table(self, listed: EpisodeEntry, images: set[str]) -> pa.Table:
        """Return the rows of an episode with the image columns in `images` and without other image columns."""
        left_out = set(layout.image_keys(self.features)) - images
        table = read_rows(listed.data, listed.index if listed.shared else None, left_out)
        if table.num_rows != listed.length or not table.num_rows:
            raise RecordingError(
                f"{listed.data} has {table.num_rows} rows of episode {listed.index}, "
                f"{self.root / 'meta'} says {listed.length}"
            )
        return table

    def _task(self, listed: EpisodeEntry, columns: _Columns) -> str:
        if columns.has("task_index"):
            number = int(columns.scalars("task_index")[0])
            if number in self.tasks:
                return self.tasks[number]
        return listed.tasks[0] if listed.tasks else ""

    def _timestamps(self, columns: _Columns) -> Float64:
        if columns.has("timestamp"):
            return columns.scalars("timestamp")
        return np.arange(columns.rows, dtype=np.float64) / self.fps

    def _cameras(self, mapping: ColumnMapping) -> dict[str, str]:
        """Return by camera the feature that contains its images."""
        stored = [*layout.video_keys(self.features), *layout.image_keys(self.features)]
        prefix = video_key("")
        columns = mapping.videos
        if columns is None:
            columns = {key.removeprefix(prefix): key for key in stored if key.startswith(prefix)}
        for camera, key in columns.items():
            if key not in stored:
                raise RecordingError(
                    f"{self.root} has no pictures {key!r} for camera {camera!r}, there are {sorted(stored)}"
                )
        return dict(columns)


class _Columns:
    """Columns of one episode's table as arrays; errors name the file and the existing columns."""

    def __init__(self, table: pa.Table, path: Path) -> None:
        self._table = table
        self._path = path
        self.rows: int = table.num_rows

    def has(self, name: str) -> bool:
        return name in self._table.column_names

    def optional(self, name: str | None) -> Float32 | None:
        return None if name is None else self.vectors(name)

    def vectors(self, name: str) -> Float32:
        """Return column `name` as float32 [N, W], read-only."""
        rows = np.ascontiguousarray(self._flat(name), dtype=np.float32).reshape(self.rows, -1)
        rows.flags.writeable = False
        return rows

    def scalars(self, name: str) -> Float64:
        """Return column `name` as float64 [N]."""
        flat = self._flat(name)
        if flat.size != self.rows:
            raise RecordingError(f"{self._path}: column {name!r} holds vectors, expected one number per row")
        return np.asarray(flat, dtype=np.float64)

    def images(self, name: str, root: Path) -> StoredImages:
        """Return the images in column `name`, whose files, if any, are below `root`."""
        import pyarrow as pa

        if not self.has(name):
            raise RecordingError(f"{self._path} has no column {name!r}, there are {self._table.column_names}")
        column = self._table.column(name).combine_chunks()
        kind = column.type
        fields = {field.name for field in kind} if pa.types.is_struct(kind) else set()
        alone = pa.types.is_binary(kind) or pa.types.is_large_binary(kind) or pa.types.is_string(kind)
        if not (alone or {"bytes", "path"} <= fields):
            raise RecordingError(f"{self._path}: column {name!r} is {column.type}, expected coded pictures")
        return StoredImages(f"{self._path}, {name!r}", _Rows(column), root)

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


class _Rows(Sequence[Mapping[str, Any] | None]):
    """Arrow column as a sequence; a row is converted to Python on access."""

    def __init__(self, column: pa.Array) -> None:
        self._column = column

    def __len__(self) -> int:
        return len(self._column)

    def __getitem__(self, index: Any) -> Any:
        return self._column[index].as_py()


def open_dataset(root: Path | str) -> Dataset:
    """Open the LeRobot dataset in the folder `root`.

    Raises: RecordingError if the folder is missing or contains no readable dataset. The message says what was found.
    """
    root = Path(root)
    if not root.is_dir():
        raise RecordingError(f"there is no dataset folder {root}")
    info = layout.read_info(root)
    return Dataset(
        root=root,
        info=info,
        fps=float(info["fps"]),
        episodes=tuple(entry(root, info, line) for line in episode_lines(root, info)),
        tasks=_numbered(root, task_lines(root, info)),
    )


def _numbered(root: Path, lines: Iterable[Mapping[str, Any]]) -> dict[int, str]:
    """Return the tasks by index. Raises: RecordingError if two tasks have the same index."""
    tasks: dict[int, str] = {}
    for line in lines:
        number, task = line["task_index"], line["task"]
        if tasks.setdefault(number, task) != task:
            raise RecordingError(
                f"{root}: task_index {number} is {tasks[number]!r} and {task!r}; allowed: one task each"
            )
    return tasks
