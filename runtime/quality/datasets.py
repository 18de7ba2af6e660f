"""Episodes of LeRobot datasets, our own and third-party ones, as a source of the checks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as pads

import robots
from robots import RobotError
from runtime.core.errors import RecordingError
from runtime.core.types import EEF_WIDTH, Float64
from runtime.datasets import layout
from runtime.datasets.features import picture_size
from runtime.datasets.mapping import ColumnMapping, video_key
from runtime.datasets.reader import Dataset
from runtime.datasets.video_frames import VideoSegment
from runtime.quality.block import (
    BLOCK_ROWS,
    Block,
    Bools,
    EpisodeSource,
    JointSpecs,
    Vector,
    VectorColumn,
    known_joints,
    unknown_joints,
)
from runtime.quality.frame_stream import FrameStream, StoredFrameStream, VideoFrameStream

STATES = ("observation.state", "observation.qpos")  # names of the state column, in order of preference
ACTION = "action"
CAPTURE, REPEATED, LOST = "capture_time.", "repeated.", "lost."
_POSES = (
    "eef_state",
    "eef_action",
)  # our columns; in other datasets the representation of orientations is unknown
_SPARSE = ("joint_velocity", "joint_effort")  # NaN in a row without a measurement
_INDEX = "frame_index"


class DatasetSource(EpisodeSource):
    """Source of the checks for episode `index` of a dataset.

    `state` names the column of measured joints, "" for the usual columns. `robot` is the robot that has these joints in
    this order; "" if only the dataset describes them.
    """

    def __init__(self, dataset: Dataset, index: int, state: str = "", robot: str = "") -> None:
        self._dataset = dataset
        self._robot = robot
        self._entry = dataset.entry(index)
        self._features = dataset.features
        self._state = self._state_column(state)
        lines = layout.read_lines(dataset.root / layout.EVA_EPISODES)
        recorded = next((line for line in lines if line.get("episode_index") == index), {})
        uuid, self.drawn = str(recorded.get("uuid", "")), recorded.get("simulated") is True
        self.name = uuid or f"{dataset.root.name}#{index}"
        self.fps = dataset.fps
        self.frames = self._entry.length
        self.remarks = ()
        self.ends = {}  # episodes with a lost video are never published
        self.schema: Mapping[str, Any] = {}
        self._keys = self._cameras()
        self.cameras = {camera: self._size(key) for camera, key in self._keys.items()}
        self.vectors = {name: self._vector(name) for name in self._features if self._is_vector(name)}
        self.started = "tick_time" if "tick_time" in self._features else ""

    def _state_column(self, state: str) -> str:
        """Return the column of measured joints, "" if there is none.

        Raises RecordingError if `state` is given and there is no such column.
        """
        if state and not (state in self._features and self._is_vector(state)):
            vectors = [name for name in self._features if self._is_vector(name)]
            raise RecordingError(
                f"{self._dataset.root} has no column {state!r} of vectors, there are {vectors}"
            )
        return state or next(
            (name for name in STATES if name in self._features and self._is_vector(name)), ""
        )

    def _is_vector(self, name: str) -> bool:
        feature = self._features[name]
        shape = feature.get("shape")
        numeric = str(feature.get("dtype")).startswith("float")
        return numeric and isinstance(shape, list | tuple) and len(shape) == 1 and tuple(shape) != (1,)

    def _vector(self, name: str) -> Vector:
        feature = self._features[name]
        width = int(feature["shape"][0])
        names = _names(feature.get("names"))
        labels = names if len(names) == width else tuple(f"number {k}" for k in range(width))
        poses = name in _POSES and width % EEF_WIDTH == 0
        role = (
            "state" if name == self._state else "action" if name == ACTION else "poses" if poses else "other"
        )
        return Vector(width, labels, role, name in _SPARSE)

    def _cameras(self) -> dict[str, str]:
        """Return the picture feature of each camera, by camera key."""
        stored = [*layout.video_keys(self._features), *layout.image_keys(self._features)]
        return {key.removeprefix(video_key("")): key for key in stored}

    def _size(self, key: str) -> tuple[int, int] | None:
        try:
            return picture_size(self._features[key])[:2]
        except RecordingError:  # the size is not declared
            return None

    def blocks(self) -> Iterator[Block]:
        path = self._entry.data
        if not path.is_file():
            raise RecordingError(f"there is no {path}, though the metadata list it")
        first = 0
        try:
            table = pads.dataset(str(path), format="parquet")
            stored = set(table.schema.names)
            absent = [name for name in self.vectors if name not in stored]
            if absent:
                raise RecordingError(f"{path} has no column {absent}, though the metadata declare it")
            columns = [name for name in self._required_columns() if name in stored]
            chosen = pads.field("episode_index") == self._entry.index if self._entry.shared else None
            scanned = table.scanner(
                columns=columns, filter=chosen, batch_size=BLOCK_ROWS, batch_readahead=1, use_threads=False
            )
            for batch in scanned.to_batches():
                if batch.num_rows:
                    yield self._block(batch, first)
                    first += batch.num_rows
        except (OSError, pa.ArrowException) as error:
            raise RecordingError(f"{path} cannot be read on after row {first - 1}: {error}") from error
        if first != self._entry.length:
            raise RecordingError(f"{path} holds {first} rows of it, the metadata say {self._entry.length}")

    def _required_columns(self) -> list[str]:
        scalars = [_INDEX, "timestamp", "tick_time", "control_source"]
        quality_columns = [name for name in self._features if name.startswith((CAPTURE, REPEATED, LOST))]
        return [*self.vectors, *scalars, *quality_columns]

    def _block(self, batch: Any, first: int) -> Block:
        columns = {name: batch.column(name) for name in batch.schema.names}
        plain = {
            name: _scalars(columns[name])
            for name in columns
            if name in ("timestamp", "tick_time") or name.startswith((CAPTURE, REPEATED, LOST))
        }
        sources = columns.get("control_source")
        return Block(
            first=first,
            rows=batch.num_rows,
            index=_scalars(columns[_INDEX]).astype(np.int64) if _INDEX in columns else None,
            clocks={name: plain[name] for name in ("timestamp", "tick_time") if name in plain},
            vectors={name: _lists(columns[name], vector) for name, vector in self.vectors.items()},
            captured={name.removeprefix(CAPTURE): plain[name] for name in plain if name.startswith(CAPTURE)},
            repeated=_marks(plain, REPEATED),
            lost=_marks(plain, LOST),
            simulated=None
            if sources is None
            else np.array([source == "sim" for source in sources.to_pylist()], np.bool_),
        )

    def open_frames(self, camera: str, sampling: int) -> FrameStream:
        key = self._keys[camera]
        if key not in self._entry.videos:
            any_vector = self._state or next(iter(self.vectors), STATES[0])
            mapping = ColumnMapping(state=any_vector, action=None, videos={camera: key})
            return StoredFrameStream(
                self._dataset.episode(self._entry.index, mapping).pictures(camera), sampling
            )
        span = self._entry.videos[key]
        stretch = None if span.start is None else VideoSegment(span.start, self._entry.length, self.fps)
        return VideoFrameStream(span.path, sampling, stretch)

    def joints(self) -> tuple[JointSpecs | None, str]:
        if not self._state:
            available = ", ".join(self.vectors) or "none"
            return (
                None,
                f"motion is not checked: no column of measured joints, there are {available} (say it with --state)",
            )
        names = self.vectors[self._state].names
        robot = self._robot or str(self._dataset.info.get("robot_type") or "")
        if self._robot:
            names = tuple(robots.load_robot(self._robot).joint_names)
        try:
            return known_joints(robot, names), ""
        except RobotError as error:
            return unknown_joints(names), f"limits are not checked: {error}"


def _marks(columns: Mapping[str, Float64], prefix: str) -> dict[str, Bools]:
    """Return flags by camera from the columns with that prefix."""
    return {
        name.removeprefix(prefix): values == 1.0
        for name, values in columns.items()
        if name.startswith(prefix)
    }


def _names(stated: Any) -> tuple[str, ...]:
    """Return the names of a feature's dimensions, from a list or a table with one list."""
    if isinstance(stated, Mapping):
        stated = next((value for value in stated.values() if isinstance(value, list)), [])
    return tuple(map(str, stated)) if isinstance(stated, list) else ()


def _scalars(column: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return numbers as float64 [N], also from lists of length one; NaN for missing values."""
    while pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        column = pa.array(
            [None if item is None or len(item) != 1 else item[0] for item in column.to_pylist()]
        )
    return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False), np.float64)


def _lists(column: Any, vector: Vector) -> VectorColumn:
    """Return lists as float32 [N, W]; rows of another width are malformed and filled with 0."""
    rows = len(column)
    missing = ~np.asarray(column.is_valid().to_numpy(zero_copy_only=False), np.bool_)
    values = np.zeros((rows, vector.width), np.float32)
    if pa.types.is_fixed_size_list(column.type):
        lengths = np.full(rows, column.type.list_size)
    elif pa.types.is_list(column.type) or pa.types.is_large_list(column.type):
        lengths = np.asarray(column.value_lengths().fill_null(0).to_numpy(zero_copy_only=False), np.int64)
    else:
        return VectorColumn(values, missing, ~missing)
    malformed = ~missing & (lengths != vector.width)
    good = ~missing & ~malformed
    flat = column.filter(pa.array(good)).flatten()
    if flat.null_count:
        flat = flat.fill_null(float("nan"))
    values[good] = flat.to_numpy(zero_copy_only=False).astype(np.float32).reshape(-1, vector.width)
    if vector.sparse:
        missing = missing | (good & np.isnan(values).all(axis=1))
    return VectorColumn(values, missing, malformed)
