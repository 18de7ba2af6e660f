"""Columns of a dataset from the rows of a journal: names, types, and values derived from the grid."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runtime.core.errors import RecordingError
from runtime.datasets.features import (
    INDEX_COLUMNS,
    WORDS,
    Feature,
    Features,
    arrow_schema,
    scalar,
    stored_features,
    vector,
)
from runtime.datasets.finished_episode import FinishedEpisode
from runtime.datasets.stats import Statistic, column_statistic

if TYPE_CHECKING:
    import pyarrow as pa

Columns = dict[str, NDArray[Any]]

# Besides state and action, no name may start with `observation` or `action`: LeRobot would use such a column as an
# input or an output of the policy.
EXTRA_VECTORS = {
    "eef_state": "eef",
    "eef_action": "eef_action",
    "joint_velocity": "qvel",
    "joint_effort": "effort",
}
NOT_FINITE = "not_finite"
# Flags that older recorders did not write, and older datasets lack; a trailing dot stands for one flag per camera.
LATER_FLAGS = ("skewed", NOT_FINITE, "lost.", "stale.")
TIMESTAMP_TOLERANCE = (
    1e-4  # LeRobot's tolerance for the difference of neighbouring timestamps from 1 / fps [s]
)


def column_features(journal: FinishedEpisode, with_success: bool) -> Features:
    """Return the declared features of all columns of an episode; videos are not among them."""
    robot = journal.manifest["robot"]
    features: Features = {
        "observation.state": vector(robot["joint_names"]),
        "action": vector(robot["joint_names"]),
    }
    for name, stream in EXTRA_VECTORS.items():
        if journal.has_stream(stream):
            features[name] = vector(robot["eef_names" if stream.startswith("eef") else "joint_names"])
    features["tick_time"] = scalar("float64")
    for stream in journal.episode.layout.capture_streams:
        features[f"capture_time.{stream}"] = scalar("float64")
    features["control_source"] = scalar("string")
    features |= {name: scalar("bool") for name in [*_flags(journal), *_later(journal)]}
    features["next.done"] = scalar("bool")
    if with_success:
        features["next.success"] = scalar("bool")
    return features | {name: scalar(dtype) for name, dtype in INDEX_COLUMNS.items()}


def _flags(journal: FinishedEpisode) -> list[str]:
    flags = ["intervention"]
    flags += ["eef_measured"] if journal.has_stream("eef") else []
    flags += ["eef_action_reported"] if journal.has_stream("eef_action") else []
    return flags + [f"repeated.{camera}" for camera in journal.cameras]


def _later(journal: FinishedEpisode) -> list[str]:
    by_camera = [name for name in LATER_FLAGS if name.endswith(".")]
    plain = [name for name in LATER_FLAGS if name not in by_camera]
    return plain + [f"{name}{camera}" for name in by_camera for camera in journal.cameras]


def without_later(features: Features, known: Collection[str]) -> Features:
    """Return `features` for a dataset that already has the features `known`.

    If an older dataset lacks some of LATER_FLAGS, these are left out.
    """
    return {
        key: feature
        for key, feature in features.items()
        if key in known
        or not any(key == name or (name[-1] == "." and key.startswith(name)) for name in LATER_FLAGS)
    }


def recorded_columns(journal: FinishedEpisode, features: Mapping[str, Feature]) -> Columns:
    """Return the values of those columns in `features` that the journal contains or that follow from the grid.

    Non-finite numbers in observations become 0 and their rows are flagged.

    Raises:
        RecordingError: An action is not finite, or an observation is not finite and the dataset lacks the flag.
    """
    state, not_finite = journal.observed("qpos")
    columns: Columns = {"observation.state": state, "action": journal.finite_vectors("action")}
    for name, stream in EXTRA_VECTORS.items():
        if name in features:
            columns[name], broken = journal.observed(stream)
            not_finite |= broken
    if not_finite.any() and NOT_FINITE not in features:
        raise RecordingError(
            f"{journal.folder}: what was observed is not finite in {int(not_finite.sum())} rows, the first is "
            f"{int(np.argmax(not_finite))}, and the dataset has no column {NOT_FINITE} to say so: publish elsewhere"
        )
    columns[NOT_FINITE] = not_finite
    for name in _later(journal):
        if name != NOT_FINITE:
            columns[name] = journal.flags(name)
    same = ["tick_time", "control_source", *_flags(journal)]
    for name in same + [name for name in features if name.startswith("capture_time.")]:
        columns[name] = journal.scalars(name)
    columns["frame_index"] = np.arange(journal.frames, dtype=np.int64)
    columns["timestamp"] = timestamps(journal.frames, journal.fps)
    columns["next.done"] = columns["frame_index"] == journal.frames - 1
    return columns


def position_columns(
    columns: Columns, *, episode_index: int, first_index: int, task_index: int, success: bool | None
) -> Columns:
    """Return `columns` with the columns of indices added, and with the success column unless `success` is None."""
    frames = len(columns["frame_index"])
    placed = columns | {
        "episode_index": np.full(frames, episode_index, dtype=np.int64),
        "index": np.arange(first_index, first_index + frames, dtype=np.int64),
        "task_index": np.full(frames, task_index, dtype=np.int64),
    }
    if success is not None:
        placed["next.success"] = columns["next.done"] & success
    return placed


def timestamps(frames: int, fps: float) -> NDArray[np.float32]:
    """Return frame / fps as float32 [N].

    After about 17 minutes float32 is too coarse for LeRobot's check that the steps between rows are even.

    Raises:
        RecordingError: LeRobot would refuse the timestamps as uneven.
    """
    exact = (np.arange(frames) / fps).astype(np.float32)
    if frames > 1 and np.abs(np.diff(exact) - 1 / fps).max() > TIMESTAMP_TOLERANCE:
        raise RecordingError(
            f"{frames} frames at {fps} Hz are too long for one episode: in a float32 timestamp "
            f"neighbouring rows differ from 1 / fps by more than {TIMESTAMP_TOLERANCE} s after 1024 s"
        )
    return exact


def table(columns: Columns, features: Mapping[str, Feature]) -> pa.Table:
    """Return the parquet table: exactly the stored features, in their order and types."""
    import pyarrow as pa

    schema = arrow_schema(features)
    arrays = []
    for field in schema:
        values = columns[field.name]
        if pa.types.is_fixed_size_list(field.type):
            flat = pa.array(values.reshape(-1), type=field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=field.type))
        else:
            arrays.append(pa.array(values.reshape(-1), type=field.type, from_pandas=False))
    return pa.Table.from_arrays(arrays, schema=schema)


def column_statistics(columns: Columns, features: Mapping[str, Feature]) -> dict[str, Statistic]:
    """Return the statistics of every stored column that can have them.

    Columns of strings have no statistics. A column with "image" in its name gets none either: LeRobot would treat the
    statistics of this column as those of an image, and refuse the dataset if their shape is not that of image
    statistics.
    """
    statistics = {}
    for key, feature in stored_features(features).items():
        if feature["dtype"] in WORDS or "image" in key:
            continue
        statistic = column_statistic(columns[key])
        if statistic is not None:
            statistics[key] = statistic
    return statistics
