"""Conversion of records to Arrow columns: one function per table, called once per batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from runtime.core.types import Float32
from runtime.ipc.messages import ExecutedTick
from runtime.recording.base import RawChunk, Row
from runtime.recording.layout import Layout


class RecordedRow(NamedTuple):
    """Row without its pictures, and the cameras whose video frame repeats the previous one.

    `lost` are the cameras among `repeated` for which the row had a new picture, which is missing in the video.
    """

    row: Row
    repeated: frozenset[str]
    lost: frozenset[str] = frozenset()


def rows_columns(layout: Layout, records: Sequence[RecordedRow]) -> dict[str, Any]:
    """Return the columns of rows.arrow."""
    rows = [record.row for record in records]
    columns: dict[str, Any] = {
        "index": [row.index for row in rows],
        "step": [row.step for row in rows],
        "time": [row.index / layout.fps for row in rows],
        "tick_time": [row.tick_time - layout.started for row in rows],
        "sequence": [row.sequence for row in rows],
        "qpos": _vectors([row.qpos for row in rows], layout.dim),
        "action": _vectors([row.action for row in rows], layout.dim),
        "eef_measured": [row.eef_measured for row in rows],
        "eef_action_reported": [row.eef_action_reported for row in rows],
        "control_source": [row.control_source for row in rows],
        "intervention": [row.intervention for row in rows],
    }
    for name in layout.streams:
        columns[name] = _vectors([getattr(row, name) for row in rows], layout.width(name))
    times = [
        [row.captured.get(stream, math.nan) - layout.started for row in rows]
        for stream in layout.capture_streams
    ]
    for stream, captured in zip(layout.capture_streams, times, strict=True):
        columns[f"capture_time.{stream}"] = captured
    columns["skewed"] = (
        spread(np.array(times, dtype=np.float64).reshape(len(times), len(rows))) > layout.max_skew_s
    )
    for camera in layout.cameras:
        columns[f"repeated.{camera}"] = [camera in record.repeated for record in records]
        columns[f"lost.{camera}"] = [camera in record.lost for record in records]
        columns[f"stale.{camera}"] = [camera in record.row.stale for record in records]
    columns["bench"] = [row.bench for row in rows]
    return columns


def spread(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spread of the streams' capture times [S, N] in each row [s]; 0 if fewer than two are known."""
    finite = np.isfinite(times)
    latest = np.where(finite, times, -np.inf).max(axis=0, initial=-np.inf)
    earliest = np.where(finite, times, np.inf).min(axis=0, initial=np.inf)
    apart: NDArray[np.float64] = np.where(finite.sum(axis=0) >= 2, latest - earliest, 0.0)
    return apart


def ticks_columns(layout: Layout, ticks: Sequence[ExecutedTick]) -> dict[str, Any]:
    """Return the columns of ticks.arrow."""
    return {
        "step": [tick.step for tick in ticks],
        "planned": [tick.planned - layout.started for tick in ticks],
        "sent": [tick.sent - layout.started for tick in ticks],
        "sequence": [tick.sequence for tick in ticks],
        "control_source": [tick.source for tick in ticks],
        "qpos": _vectors([tick.qpos for tick in ticks], layout.dim),
        "executed": _vectors([tick.executed for tick in ticks], layout.dim),
        "changes": [tick.notes for tick in ticks],
        "refused": [tick.refused for tick in ticks],
        "chunk_id": [_leading(tick) for tick in ticks],
        "woke": [None if tick.woke is None else tick.woke - layout.started for tick in ticks],
    }


def smoothed_columns(layout: Layout, ticks: Sequence[ExecutedTick]) -> dict[str, Any]:
    """Return the columns of smoothed.arrow for `ticks`, each of which must have a `smoothed` action."""
    return {
        "step": [tick.step for tick in ticks],
        "smoothed": _vectors([tick.smoothed for tick in ticks], layout.dim),
        "chunk_ids": [tick.chunk_ids for tick in ticks],
        "weights": [tick.weights for tick in ticks],
    }


def raw_columns(layout: Layout, chunks: Sequence[RawChunk]) -> dict[str, Any]:
    """Return the columns of raw.arrow."""
    del layout  # the width comes from the chunks: the policy's own
    lengths = [len(chunk.actions) for chunk in chunks]

    def each(values: Sequence[object]) -> list[object]:
        return [value for value, length in zip(values, lengths, strict=True) for _ in range(length)]

    widths = [
        chunk.actions.shape[1] for chunk, length in zip(chunks, lengths, strict=True) for _ in range(length)
    ]
    numbers = np.concatenate([chunk.actions.ravel() for chunk in chunks])
    return {
        "chunk_id": each([chunk.chunk_id for chunk in chunks]),
        "observation_step": each([chunk.observation_step for chunk in chunks]),
        "arrival_step": each([chunk.arrival_step for chunk in chunks]),
        "index": [index for length in lengths for index in range(length)],
        "target_step": np.concatenate([chunk.target_steps for chunk in chunks]),
        "action": pa.ListArray.from_arrays(np.cumsum([0, *widths], dtype=np.int32), numbers),
        "space": each([chunk.space for chunk in chunks]),
        "delay": each([chunk.delay for chunk in chunks]),
        "mistimed": each([chunk.mistimed for chunk in chunks]),
        "inference_ms": each([chunk.inference_ms for chunk in chunks]),
        "strategy": each([chunk.strategy for chunk in chunks]),
        "overlap": each([chunk.overlap for chunk in chunks]),
        "ik_position_error": _by_arm([chunk.ik_position_error for chunk in chunks], lengths),
        "ik_rotation_error": _by_arm([chunk.ik_rotation_error for chunk in chunks], lengths),
        "ik_flags": _by_arm([chunk.ik_flags for chunk in chunks], lengths),
        "eef_source": each([chunk.eef or None for chunk in chunks]),
    }


COLUMNS: Mapping[str, Callable[[Layout, Any], dict[str, Any]]] = {
    "rows": rows_columns,
    "ticks": ticks_columns,
    "smoothed": smoothed_columns,
    "raw": raw_columns,
}


def _vectors(values: Sequence[Float32 | None], width: int) -> Any:
    missing = np.array([value is None for value in values])
    numbers = np.zeros((len(values), width), dtype=np.float32)
    for position, value in enumerate(values):
        if value is not None:
            numbers[position] = value
    mask = pa.array(missing) if missing.any() else None
    return pa.FixedSizeListArray.from_arrays(pa.array(numbers.ravel()), width, mask=mask)


def _by_arm(figures: Sequence[NDArray[Any] | None], lengths: Sequence[int]) -> list[list[Any] | None]:
    """Return for each row of all chunks the list of its values by arm; None if its chunk has no values.

    `figures` has the values [rows, arms] of each chunk, or None, and `lengths` the number of rows of each chunk.
    """
    rows: list[list[Any] | None] = []
    for figure, length in zip(figures, lengths, strict=True):
        rows += [None] * length if figure is None else figure.tolist()
    return rows


def _leading(tick: ExecutedTick) -> int:
    """Return the id of the chunk with the largest weight in the tick; -1 if no chunk contributed.

    If several chunks have the largest weight, the newest of them counts.
    """
    return max(zip(tick.weights, tick.chunk_ids, strict=True), default=(0.0, -1))[1]
