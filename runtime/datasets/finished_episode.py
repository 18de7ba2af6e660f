"""Closed episode as publication reads it, with the columns of its rows as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.core.errors import RecordingError
from runtime.core.types import Float32
from runtime.recording.reader import Episode, open_episode


@dataclass(frozen=True, slots=True, eq=False)
class FinishedEpisode:
    """Closed episode: its manifest, its outcome, and its rows column by column."""

    episode: Episode
    manifest: Mapping[str, Any]
    outcome: Mapping[str, Any]

    @property
    def folder(self) -> Path:
        return self.episode.path

    @property
    def uuid(self) -> str:
        return self.episode.layout.uuid

    @property
    def robot(self) -> str:
        return str(self.manifest["robot"]["name"])

    @property
    def task(self) -> str:
        return str(self.manifest.get("task", ""))

    @property
    def fps(self) -> float:
        return self.episode.layout.fps

    @property
    def frames(self) -> int:
        """Number of rows of the dataset grid; each row has one image per camera."""
        return self.episode.frames

    @property
    def cameras(self) -> Mapping[str, tuple[int, int]]:
        """Height and width of the images by camera key."""
        return self.episode.layout.cameras

    def has_stream(self, name: str) -> bool:
        """Return True if the vector stream `name` was recorded."""
        return name in self.episode.layout.streams

    def vectors(self, name: str) -> Float32:
        """Return column `name` as float32 [N, W], NaN in rows without a value."""
        width = self.episode.layout.width(name)
        column = self._column(name)
        valid = np.asarray(column.is_valid().to_numpy(zero_copy_only=False), dtype=np.bool_)
        values = np.full((self.frames, width), np.nan, dtype=np.float32)
        values[valid] = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
        return values

    def finite_vectors(self, name: str) -> Float32:
        """Return column `name` as float32 [N, W].

        Raises: RecordingError, which names the first row that is not finite.
        """
        values = self.vectors(name)
        broken = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(broken):
            row = int(broken[0])
            raise RecordingError(f"{self.folder}: {name} of row {row} is not finite: {values[row].tolist()}")
        return values

    def observed(self, name: str) -> tuple[Float32, NDArray[np.bool_]]:
        """Return column `name` as float32 [N, W], and bool [N]: which rows had recorded values that are not finite.

        In these rows the values that are not finite are replaced by 0. Rows without a recorded value are NaN and not
        marked.
        """
        values = self.vectors(name)
        valid = np.asarray(self._column(name).is_valid().to_numpy(zero_copy_only=False), dtype=np.bool_)
        broken = ~np.isfinite(values) & valid[:, None]
        values[broken] = 0.0
        return values, np.any(broken, axis=1)

    def flags(self, name: str) -> NDArray[np.bool_]:
        """Return column `name` as booleans [N]; in recordings of older recorders, which did not write it, all are
        False.
        """
        return np.asarray(self._column(name).fill_null(False).to_numpy(zero_copy_only=False), dtype=np.bool_)

    def scalars(self, name: str) -> np.ndarray[Any, Any]:
        """Return column `name` as an array [N]. Raises: RecordingError if a row has no value."""
        column = self._column(name)
        if column.null_count:
            raise RecordingError(f"{self.folder}: {name} is missing in {column.null_count} rows")
        return np.asarray(column.to_numpy(zero_copy_only=False))

    def _column(self, name: str) -> Any:
        return self.episode.rows.column(name).combine_chunks()


def read_finished_episode(folder: Path, videos: bool = True) -> FinishedEpisode:
    """Read the closed episode in `folder`, without its videos if these are not needed.

    Raises: RecordingError if there is no episode or it is still open.
    """
    episode = open_episode(folder, videos)
    if episode.outcome is None:
        raise RecordingError(f"{folder} has no outcome.json: it is being recorded, or wants repair")
    robot = episode.manifest["robot"]
    widths = {"joint_names": episode.layout.dim}
    if any(name.startswith("eef") for name in episode.layout.streams):
        widths["eef_names"] = episode.layout.eef_dim
    for key, width in widths.items():
        names = robot.get(key) if isinstance(robot, Mapping) else None
        if not isinstance(names, list) or len(names) != width:
            raise RecordingError(
                f"{folder / 'manifest.json'}: robot.{key} is {names!r}, must be {width} names"
            )
    return FinishedEpisode(episode, episode.manifest, episode.outcome)
