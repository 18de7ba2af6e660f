"""Figures of an outcome about the rows of an episode, read back from its table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from runtime.core.errors import RecordingError
from runtime.recording.columns import spread
from runtime.recording.layout import Layout

HELD = ("hold", "none")  # sources of ticks in which no motion was requested


@dataclass(frozen=True, slots=True)
class Summary:
    """Figures over the first `frames` rows. `skew` is the spread of the capture times within a row [s]."""

    frames: int
    duration_s: float  # [s], without held rows
    held_rows: int
    repeated: Mapping[str, int]  # by camera
    lost: Mapping[str, int]  # by camera: repeats for which there was a picture
    stale: Mapping[str, int]  # by camera: rows with too old a picture
    skewed_rows: int
    skew_mean_s: float | None  # None if no row has two known capture times
    skew_max_s: float | None

    def to_dict(self) -> dict[str, object]:
        """Return the figures in the form of outcome.json."""
        return {
            "frames": self.frames,
            "duration_s": self.duration_s,
            "held_rows": self.held_rows,
            "repeated": dict(self.repeated),
            "lost": dict(self.lost),
            "stale": dict(self.stale),
            "skewed_rows": self.skewed_rows,
            "skew": {"mean_s": self.skew_mean_s, "max_s": self.skew_max_s},
        }


def summarise(path: Path, layout: Layout, frames: int) -> Summary:
    """Return the summary of the first `frames` rows, read batch by batch so that memory stays constant.

    Raises RecordingError if fewer rows can be read.
    """
    tally = _Tally(layout)
    try:
        with pa.OSFile(str(path)) as file:
            batches = pa.ipc.open_stream(file)
            while tally.frames < frames:
                tally.add(batches.read_next_batch().slice(0, frames - tally.frames))
    except (StopIteration, pa.ArrowInvalid, OSError) as error:
        raise RecordingError(f"{path}: {tally.frames} rows readable, {frames} expected: {error!r}") from error
    return tally.summary()


class _Tally:
    def __init__(self, layout: Layout) -> None:
        self.frames = 0
        self._layout = layout
        self._held = 0
        self._flags = {flag: dict.fromkeys(layout.cameras, 0) for flag in ("repeated", "lost", "stale")}
        self._skewed = 0
        self._spread_sum, self._spread_count, self._spread_max = 0.0, 0, -math.inf

    def add(self, batch: Any) -> None:
        self.frames += batch.num_rows
        self._held += sum(source in HELD for source in batch.column("control_source").to_pylist())
        for flag, counts in self._flags.items():
            for camera in counts:
                counts[camera] += _count_true(batch, f"{flag}.{camera}")
        self._skewed += _count_true(batch, "skewed")
        apart = self._spread(batch)
        if apart.size:
            self._spread_sum += float(apart.sum())
            self._spread_count += apart.size
            self._spread_max = max(self._spread_max, float(apart.max()))

    def _spread(self, batch: Any) -> Any:
        streams = self._layout.capture_streams
        if len(streams) < 2:
            return np.empty(0)
        times = np.stack([batch.column(f"capture_time.{stream}").to_numpy() for stream in streams])
        return spread(times[:, np.isfinite(times).sum(axis=0) >= 2])

    def summary(self) -> Summary:
        has_spread = self._spread_count > 0
        return Summary(
            frames=self.frames,
            duration_s=(self.frames - self._held) / self._layout.fps,
            held_rows=self._held,
            repeated=self._flags["repeated"],
            lost=self._flags["lost"],
            stale=self._flags["stale"],
            skewed_rows=self._skewed,
            skew_mean_s=self._spread_sum / self._spread_count if has_spread else None,
            skew_max_s=self._spread_max if has_spread else None,
        )


def _count_true(batch: Any, column: str) -> int:
    """Return the number of rows whose flag `column` is set; 0 if the table is older than the flag."""
    return int(batch.column(column).true_count) if column in batch.schema.names else 0
