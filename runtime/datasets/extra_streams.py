"""Streams of an imported episode besides joints and images: velocities, efforts, end-effector poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from robots import EEF_FIELDS
from runtime.core.errors import RecordingError
from runtime.core.types import Float32
from runtime.datasets.mapping import ColumnMapping
from runtime.datasets.reader import Dataset


class _Kind(NamedTuple):
    """Kind of extra stream.

    `mapped` is the attribute of a ColumnMapping that names the stream's column. `read` is the attribute of a
    RecordedEpisode that has the stream's values. `columns` are the names that the column may have.
    """

    mapped: str
    read: str
    columns: tuple[str, ...]  # the first that exists is used


_KINDS: Mapping[str, _Kind] = {
    "qvel": _Kind("velocity", "qvel", ("joint_velocity", "observation.velocity", "observation.qvel")),
    "effort": _Kind("effort", "effort", ("joint_effort", "observation.effort")),
    "eef": _Kind("eef", "eef", ("eef_state", "observation.eef")),
    "eef_action": _Kind("action_eef", "action_eef", ("eef_action", "action_eef")),
}
_POSES = ("eef", "eef_action")


@dataclass(frozen=True, slots=True, eq=False)
class ExtraStreams:
    """Extra streams of an episode: vectors [N, W] and column name by stream, and the names of the poses' dimensions.

    `left_out` has a sentence with the reason for each stream that could not be used.
    """

    vectors: Mapping[str, Float32]
    columns: Mapping[str, str]
    eef_names: Sequence[str]
    left_out: Sequence[str]

    def row(self, index: int) -> dict[str, Any]:
        """Return the vectors of row `index` by stream, as arguments of a Row; a vector of only NaN becomes None."""
        row = {stream: vectors[index] for stream, vectors in self.vectors.items()}
        return {stream: None if np.isnan(vector).all() else vector for stream, vector in row.items()}


def read_extra_streams(dataset: Dataset, index: int, state: str) -> ExtraStreams:
    """Read the streams of episode `index` besides the joints, whose column is `state`.

    Velocities and efforts must have as many values as the state. The dimensions of poses must have the names that our
    recordings use, and be the same for both streams of poses. Streams that do not fit are left out.
    """
    vectors: dict[str, Float32] = {}
    columns: dict[str, str] = {}
    names: Sequence[str] = ()
    left_out: list[str] = []
    for stream, kind in _KINDS.items():
        column = next((name for name in kind.columns if name in dataset.features and name != state), None)
        if column is None:
            continue
        try:
            pose_names = _pose_names(dataset, column, names) if stream in _POSES else ()
            vectors[stream] = _read(dataset, index, state, kind, column, len(pose_names))
        except RecordingError as error:
            left_out.append(f"{column} is left out: {error}")
            continue
        columns[stream] = column
        names = pose_names or names
    return ExtraStreams(vectors, columns, names, left_out)


def dimension_names(feature: Mapping[str, Any]) -> list[str]:
    """Return the names of a feature's dimensions; [] if it declares none."""
    names = feature.get("names")
    if isinstance(names, Mapping) and len(names) == 1:  # {"motors": [...]}, as in some datasets
        names = next(iter(names.values()))
    return [str(name) for name in names] if isinstance(names, list) else []


def _pose_names(dataset: Dataset, column: str, expected: Sequence[str]) -> list[str]:
    pose_names = dimension_names(dataset.features[column])
    fields = [name.rpartition(".")[2] for name in pose_names]
    if not pose_names or fields != list(EEF_FIELDS) * (len(pose_names) // len(EEF_FIELDS)):
        raise RecordingError(
            f"its numbers are called {', '.join(pose_names) or 'nothing'}; allowed: ARM.{', ARM.'.join(EEF_FIELDS)}"
        )
    if expected and pose_names != list(expected):
        raise RecordingError(
            f"its numbers are {', '.join(pose_names)}, those of the measured poses {', '.join(expected)}"
        )
    return pose_names


def _read(dataset: Dataset, index: int, state: str, kind: _Kind, column: str, width: int) -> Float32:
    """Return the values of `column` in episode `index`. Raises: RecordingError if its rows have another width.

    The required width is `width`, or that of the state if `width` is 0.
    """
    episode = dataset.episode(
        index,
        ColumnMapping.model_validate({"state": state, "action": None, "videos": {}, kind.mapped: column}),
    )
    values: Float32 = getattr(episode, kind.read)
    expected = width or episode.qpos.shape[1]
    if values.shape[1] != expected:
        raise RecordingError(f"its rows have {values.shape[1]} numbers, expected {expected}")
    return values
