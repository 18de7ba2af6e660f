"""One table per run with all three streams: DATA/exports/<prompt>/<mode>/<strategy>/<run>.parquet."""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from runtime.core.errors import RecordingError
from runtime.recording.files import disk_error, exclusive, read_json, to_json, write_atomic
from runtime.recording.layout import Layout
from runtime.recording.outcome_seal import read_outcome, without_digests
from runtime.recording.scrub import require_intact
from runtime.recording.tables import SCHEMAS, read_table

FOLDER = "exports"
FORMAT = 1
NO_PROMPT = "no-prompt"
_STREAMS = ("ticks", "smoothed", "raw")
_FILES = ("manifest.json", *(f"{name}.arrow" for name in _STREAMS))
_NAME_BYTES = 120  # longest folder name [bytes]; file systems allow 255
_ROWS_TOGETHER = 1 << 16
_VECTOR = pa.list_(pa.float32())

SCHEMA = pa.schema(
    [
        pa.field("stream", pa.string(), nullable=False),  # raw, smoothed, executed
        pa.field("step", pa.int64()),  # control step of the row; raw: null if it was dropped
        pa.field("time", pa.float64()),  # planned time of that step [s since manifest.started_monotonic]
        pa.field("sent", pa.float64()),  # executed: send time on the same clock
        pa.field("woke", pa.float64()),  # executed: wake-up time of the loop; null in lockstep
        pa.field("chunk_id", pa.int64()),  # raw: the row's chunk; else the chunk with the largest weight
        pa.field("observation_step", pa.int64()),  # raw
        pa.field("arrival_step", pa.int64()),  # raw: null if it never reached the control loop
        pa.field("index", pa.int64()),  # raw: row within its chunk
        pa.field("target_step", pa.int64()),  # raw: same as `step`
        pa.field("delay", pa.int64()),  # raw: arrival - observation [steps]
        pa.field("mistimed", pa.int64()),  # raw: steps by which k_max shifted the chunk
        pa.field("overlap", pa.int64()),  # raw: steps that were blended with the previous plan
        pa.field("strategy", pa.string()),  # raw: kind of the strategy that merged it
        pa.field("inference_ms", pa.float64()),  # raw
        pa.field("space", pa.string()),  # raw: joint or eef; other streams are joints
        pa.field("ik_position_error", _VECTOR),  # raw: by arm [m], null for joints
        pa.field("ik_rotation_error", _VECTOR),  # raw: by arm [rad], null for joints
        pa.field(
            "ik_flags", pa.list_(pa.uint8())
        ),  # raw: by arm, bits: missed 1, limit 2, velocity 4, singular 8
        pa.field(
            "eef_source", pa.string()
        ),  # raw: origin of the policy's poses, measured or fk; null: it received none
        pa.field("chunk_ids", pa.list_(pa.int64())),  # smoothed: chunks of the step; 0 is the held target
        pa.field("weights", pa.list_(pa.float64())),  # smoothed
        pa.field("action", _VECTOR),  # null if nothing was sent
        pa.field("measured", _VECTOR),  # executed: measured joints at the tick
        pa.field("control_source", pa.string()),  # executed
        pa.field("changes", pa.list_(pa.string())),  # executed: changes by safety, or reasons of its refusal
        pa.field("refused", pa.bool_()),  # executed
    ]
)


@dataclass(frozen=True, slots=True)
class _Run:
    """Content of an exported run: manifest, outcome and tables."""

    manifest: Mapping[str, object]
    outcome: Mapping[str, object]
    ticks: Any
    smoothed: Any
    raw: Any


def write_export(folder: Path, root: Path) -> Path:
    """Export the episode in `folder` to its path below `root`, unless an export there is up to date; return the path.

    Any number of processes may do so at once. Raises RecordingError if the episode has no outcome yet, is damaged, or
    the disk refuses the file.
    """
    manifest = read_json(folder / "manifest.json")
    if not (folder / "outcome.json").exists():
        raise RecordingError(f"{folder} has no outcome.json: it is being recorded, or wants repair")
    path = export_path(manifest, root)
    with exclusive(path.parent):
        if not is_exported(folder, path):
            require_intact(folder, _FILES)
            write_atomic(path, _content(_read(folder, manifest)))
    return path


def export_table(folder: Path) -> bytes:
    """Return the table of the episode in `folder` as a parquet file. Raises RecordingError if it is damaged."""
    return _content(_read(folder, read_json(folder / "manifest.json")))


def export_path(manifest: Mapping[str, object], root: Path) -> Path:
    """Return the path of the export of the run with this manifest.

    Raises RecordingError if the manifest lacks a valid uuid.
    """
    prompt, mode, strategy = (manifest.get(key) for key in ("task", "mode", "strategy"))
    run = Layout.from_manifest(manifest).uuid
    return root / FOLDER / slug(prompt, NO_PROMPT) / slug(mode) / slug(strategy) / f"{run}.parquet"


def is_exported(folder: Path, path: Path) -> bool:
    """Return True if `path` was written after the episode in `folder` had ended or was repaired."""
    try:
        return path.stat().st_mtime_ns >= (folder / "outcome.json").stat().st_mtime_ns
    except FileNotFoundError:
        return False
    except OSError as error:
        raise disk_error("looking at", path, error) from error


def slug(text: object, empty: str = "unknown") -> str:
    """Return `text` as the name of one folder: letters and digits of any script, everything else as single hyphens.

    A name that loses information or is too long gets a part of the text's hash, so that two texts never share a name.
    """
    title = text if isinstance(text, str) else ""
    if not title.strip():
        return empty
    cleaned = "".join(c if c.isalnum() else " " for c in unicodedata.normalize("NFKC", title))
    name = "-".join(cleaned.split()).encode()[:_NAME_BYTES].decode(errors="ignore")
    if name.replace("-", " ") == title and name != empty:
        return name
    mark = hashlib.sha256(title.encode(errors="surrogatepass")).hexdigest()[:8]
    return f"{name}-{mark}" if name else mark


def _read(folder: Path, manifest: Mapping[str, object]) -> _Run:
    layout = Layout.from_manifest(manifest)
    tables = {name: read_table(folder / f"{name}.arrow", SCHEMAS[name](layout)).table for name in _STREAMS}
    return _Run(manifest, without_digests(read_outcome(folder)), **tables)


def _content(run: _Run) -> bytes:
    """Return the content of the parquet file.

    Each stream begins a row group, so that a reader of one stream can skip the rest.
    """
    schema = SCHEMA.with_metadata(_metadata(run))
    sink = pa.BufferOutputStream()
    try:
        with pq.ParquetWriter(sink, schema, compression="zstd") as writer:
            for columns, rows in (
                (_raw(run), run.raw),
                (_smoothed(run), run.smoothed),
                (_executed(run), run.ticks),
            ):
                writer.write_table(_table(columns, rows.num_rows, schema), row_group_size=_ROWS_TOGETHER)
    except pa.ArrowException as error:
        raise RecordingError(f"run {run.manifest.get('uuid')} cannot be exported: {error}") from error
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _metadata(run: _Run) -> dict[str, bytes]:
    prompt = run.manifest.get("task")
    return {
        "eva.format": str(FORMAT).encode(),
        "eva.prompt": (prompt if isinstance(prompt, str) else "").encode(errors="replace"),
        "eva.manifest": to_json(run.manifest, "the manifest"),
        "eva.outcome": to_json(run.outcome, "the outcome"),
    }


def _table(columns: Mapping[str, Any], rows: int, schema: Any) -> Any:
    arrays = [
        _cast(columns[field.name], field.type) if field.name in columns else pa.nulls(rows, field.type)
        for field in schema
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _cast(values: Any, kind: Any) -> Any:
    return values.cast(kind) if isinstance(values, (pa.Array, pa.ChunkedArray)) else pa.array(values, kind)


def _raw(run: _Run) -> dict[str, Any]:
    raw = run.raw
    same = (
        *("chunk_id", "observation_step", "index", "mistimed", "overlap", "inference_ms", "space", "action"),
        *("ik_position_error", "ik_rotation_error", "ik_flags", "eef_source"),
    )
    target = _null_if_negative(raw["target_step"])
    strategy = raw["strategy"]
    return {name: raw[name] for name in same} | {
        "stream": ["raw"] * raw.num_rows,
        "step": target,
        "target_step": target,
        "time": _planned(run, raw["target_step"]),
        "arrival_step": _null_if_negative(raw["arrival_step"]),
        "delay": pc.if_else(pc.less(raw["arrival_step"], 0), None, raw["delay"]),
        "strategy": pc.if_else(pc.equal(strategy, ""), None, strategy),
    }


def _smoothed(run: _Run) -> dict[str, Any]:
    smoothed = run.smoothed
    return {
        "stream": ["smoothed"] * smoothed.num_rows,
        "step": smoothed["step"],
        "time": _planned(run, smoothed["step"]),
        "chunk_id": _owners(run, smoothed["step"]),
        "chunk_ids": smoothed["chunk_ids"],
        "weights": smoothed["weights"],
        "action": smoothed["smoothed"],
    }


def _executed(run: _Run) -> dict[str, Any]:
    ticks = run.ticks
    same = ("step", "sent", "woke", "control_source", "changes", "refused")
    return {name: ticks[name] for name in same} | {
        "stream": ["executed"] * ticks.num_rows,
        "time": ticks["planned"],
        "chunk_id": _null_if_negative(ticks["chunk_id"]),
        "action": ticks["executed"],
        "measured": ticks["qpos"],
    }


def _null_if_negative(numbers: Any) -> Any:
    """Return the numbers with null in place of -1, which means none."""
    return pc.if_else(pc.less(numbers, 0), None, numbers)


def _planned(run: _Run, steps: Any) -> Any:
    return _at_steps(run.ticks, "planned", steps)


def _owners(run: _Run, steps: Any) -> Any:
    return _null_if_negative(_at_steps(run.ticks, "chunk_id", steps))


def _at_steps(ticks: Any, column: str, steps: Any) -> Any:
    """Return the values of `column` of the ticks at the given steps; null for a step without a tick."""
    tick_steps, targets = ticks["step"].to_numpy(), steps.to_numpy()
    places = np.searchsorted(tick_steps, targets)
    present = places < len(tick_steps)
    present[present] = tick_steps[places[present]] == targets[present]
    return ticks[column].take(pa.array(np.where(present, places, 0), mask=~present))
