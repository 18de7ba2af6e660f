"""Admission of records to the journal: a check against the manifest, and copies of arrays that may be reused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.types import Float32, UInt8
from runtime.ipc.messages import ExecutedTick
from runtime.recording.base import RawChunk, Row
from runtime.recording.layout import Layout

_NONE: Mapping[str, UInt8 | None] = MappingProxyType({})


def admit_row(layout: Layout, row: Row, expected: int) -> Row:
    """Return a copy of `row` without pictures.

    Vectors that the manifest does not list are dropped; listed vectors may be absent (null in the table). Raises
    RecordingError if `row` does not have the index `expected` or does not fit the manifest.
    """
    if row.index != expected:
        raise RecordingError(
            f"row {row.index} given, row {expected} is next: rows are neither skipped nor repeated"
        )
    _check_pictures(layout, row)
    name = f"row {row.index}"
    return replace(
        row,
        qpos=_copy(f"{name}: qpos", row.qpos, layout.dim),
        action=_copy(f"{name}: action", row.action, layout.dim),
        captured=dict(row.captured),
        pictures=_NONE,
        qvel=_listed(layout, name, "qvel", row.qvel),
        effort=_listed(layout, name, "effort", row.effort),
        eef=_listed(layout, name, "eef", row.eef),
        eef_action=_listed(layout, name, "eef_action", row.eef_action),
    )


def admit_tick(layout: Layout, tick: ExecutedTick) -> ExecutedTick:
    """Return a copy of `tick`.

    Raises RecordingError if a vector has a wrong width, or if the numbers of chunks and weights in the tick differ.
    """
    name = f"tick {tick.step}"
    if len(tick.chunk_ids) != len(tick.weights):
        raise RecordingError(
            f"{name}: {len(tick.chunk_ids)} chunk_ids and {len(tick.weights)} weights, must pair"
        )
    smoothed, executed = tick.smoothed, tick.executed
    return replace(
        tick,
        qpos=_copy(f"{name}: qpos", tick.qpos, layout.dim),
        smoothed=None if smoothed is None else _copy(f"{name}: smoothed", smoothed, layout.dim),
        executed=None if executed is None else _copy(f"{name}: executed", executed, layout.dim),
    )


def admit_chunk(chunk: RawChunk) -> RawChunk:
    """Return a copy of `chunk`. Raises RecordingError if its actions are not [H, W] with H target steps."""
    actions = np.array(chunk.actions, dtype=np.float32)
    targets = np.array(chunk.target_steps, dtype=np.int64)
    if actions.ndim != 2 or targets.shape != actions.shape[:1]:
        raise RecordingError(
            f"chunk {chunk.chunk_id}: actions {actions.shape} and target_steps {targets.shape}, "
            "must be [H, W] and [H]"
        )
    met: dict[str, Any] = {
        name: None if (values := getattr(chunk, name)) is None else np.array(values)
        for name in ("ik_position_error", "ik_rotation_error", "ik_flags")
    }
    for name, values in met.items():
        if values is not None and (values.ndim != 2 or len(values) != len(actions)):
            raise RecordingError(
                f"chunk {chunk.chunk_id}: {name} {values.shape}, must be [{len(actions)}, arms]"
            )
    return replace(chunk, actions=actions, target_steps=targets, **met)


def _check_pictures(layout: Layout, row: Row) -> None:
    if row.pictures.keys() != layout.cameras.keys():
        raise RecordingError(
            f"row {row.index}: pictures of {sorted(row.pictures)}, "
            f"must be of {sorted(layout.cameras)} (None repeats the last one)"
        )
    for camera, picture in row.pictures.items():
        expected = (*layout.pictures[camera], 3)
        if picture is not None and (picture.shape != expected or picture.dtype != np.uint8):
            raise RecordingError(
                f"row {row.index}: camera {camera} gave {picture.dtype} {picture.shape}, "
                f"must be uint8 {expected}"
            )


def _listed(layout: Layout, name: str, stream: str, vector: Float32 | None) -> Float32 | None:
    if vector is None or stream not in layout.streams:
        return None
    return _copy(f"{name}: {stream}", vector, layout.width(stream))


def _copy(name: str, vector: Float32, width: int) -> Float32:
    copied = np.array(vector, dtype=np.float32)
    if copied.shape != (width,):
        raise RecordingError(f"{name} has shape {copied.shape}, must be ({width},)")
    return copied
