"""Tables of an episode: Arrow schemas, a stream writer that survives a kill, and its reader."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from runtime.core.errors import RecordingError
from runtime.recording.columns import COLUMNS
from runtime.recording.files import AppendFile, write_atomic
from runtime.recording.layout import Layout

END_OF_STREAM = b"\xff\xff\xff\xff\x00\x00\x00\x00"  # Arrow columnar format, "IPC streaming format"


def rows_schema(layout: Layout) -> Any:
    """Return the schema of rows.arrow: one row per step of the dataset grid.

    Row k belongs to frame k of every video.
    """
    vectors = [pa.field(name, _vector(layout.width(name))) for name in layout.streams]
    captures = [pa.field(f"capture_time.{stream}", pa.float64()) for stream in layout.capture_streams]
    flags = [
        pa.field(f"{flag}.{camera}", pa.bool_())
        for flag in ("repeated", "lost", "stale")
        for camera in layout.cameras
    ]
    return pa.schema(
        [
            pa.field("index", pa.int64()),
            pa.field("step", pa.int64()),
            pa.field("time", pa.float64()),
            pa.field("tick_time", pa.float64()),
            pa.field("sequence", pa.int64()),
            pa.field("qpos", _vector(layout.dim)),
            pa.field("action", _vector(layout.dim)),
            *vectors,
            pa.field("eef_measured", pa.bool_()),
            pa.field("eef_action_reported", pa.bool_()),
            pa.field("control_source", pa.string()),
            pa.field("intervention", pa.bool_()),
            *captures,
            pa.field("skewed", pa.bool_()),
            *flags,
            pa.field("bench", pa.string()),
        ]
    )


def ticks_schema(layout: Layout) -> Any:
    """Return the schema of ticks.arrow, the executed stream: one row per control tick.

    `executed` is null if nothing was sent.
    """
    return pa.schema(
        [
            pa.field("step", pa.int64()),
            pa.field("planned", pa.float64()),
            pa.field("sent", pa.float64()),
            pa.field("sequence", pa.int64()),
            pa.field("control_source", pa.string()),
            pa.field("qpos", _vector(layout.dim)),
            pa.field("executed", _vector(layout.dim)),
            pa.field("changes", pa.list_(pa.string())),
            pa.field("refused", pa.bool_()),
            pa.field("chunk_id", pa.int64()),
            pa.field("woke", pa.float64()),
        ]
    )


def smoothed_schema(layout: Layout) -> Any:
    """Return the schema of smoothed.arrow: planned actions, with the chunks that made them.

    Ticks without a planned action have no row.
    """
    return pa.schema(
        [
            pa.field("step", pa.int64()),
            pa.field("smoothed", _vector(layout.dim)),
            pa.field("chunk_ids", pa.list_(pa.int64())),
            pa.field("weights", pa.list_(pa.float64())),
        ]
    )


def raw_schema(layout: Layout) -> Any:
    """Return the schema of raw.arrow: one row per row of every chunk, in the policy's own space and width."""
    return pa.schema(
        [
            pa.field("chunk_id", pa.int64()),
            pa.field("observation_step", pa.int64()),
            pa.field("arrival_step", pa.int64()),
            pa.field("index", pa.int64()),
            pa.field("target_step", pa.int64()),
            pa.field("action", pa.list_(pa.float32())),
            pa.field("space", pa.string()),
            pa.field("delay", pa.int64()),
            pa.field("mistimed", pa.int64()),
            pa.field("inference_ms", pa.float64()),
            pa.field("strategy", pa.string()),
            pa.field("overlap", pa.int64()),
            pa.field("ik_position_error", pa.list_(pa.float32())),
            pa.field("ik_rotation_error", pa.list_(pa.float32())),
            pa.field("ik_flags", pa.list_(pa.uint8())),
            pa.field("eef_source", pa.string()),
        ]
    )


SCHEMAS: Mapping[str, Callable[[Layout], Any]] = {
    "rows": rows_schema,
    "ticks": ticks_schema,
    "smoothed": smoothed_schema,
    "raw": raw_schema,
}


# Columns added later, oldest first; they are null in older episodes. A name that ends with a dot stands for the columns
# of all cameras.
ADDED = (
    frozenset({"strategy", "overlap", "woke"}),
    frozenset({"ik_position_error", "ik_rotation_error", "ik_flags", "eef_source"}),
    frozenset({"skewed", "lost.", "stale."}),
    frozenset({"bench"}),
)


def added(column: str) -> bool:
    """Return True if `column` was added later, so that older tables may lack it."""
    return _among(column, frozenset[str]().union(*ADDED))


def _among(column: str, names: frozenset[str]) -> bool:
    return column in names or f"{column.partition('.')[0]}." in names


def _vector(width: int) -> Any:
    return pa.list_(pa.float32(), width)


def _generations(schema: Any) -> list[Any]:
    """Return the present schema, and the schema before each addition of columns."""
    absent = [frozenset[str]().union(*ADDED[first:]) for first in range(len(ADDED) + 1)]
    return [pa.schema([field for field in schema if not _among(field.name, names)]) for names in absent]


class TableWriter:
    """Arrow IPC stream: records wait in memory until `flush` turns them into one batch and one write.

    Any thread may add; one thread flushes, syncs and closes.
    """

    def __init__(self, folder: Path, name: str, layout: Layout) -> None:
        self._layout = layout
        self._schema = SCHEMAS[name](layout)
        self._columns = COLUMNS[name]
        self._waiting: deque[Any] = deque()
        self._unwritten, self._unwritten_rows = b"", 0
        self._ended = False
        self.file = AppendFile(folder / f"{name}.arrow")
        try:
            self.file.write(self._schema.serialize().to_pybytes())
        except RecordingError:
            self.file.close()
            raise

    @property
    def waiting(self) -> int:
        """Number of records that are only in memory."""
        return len(self._waiting)

    def add(self, record: object) -> None:
        """Add one record; neither it nor its arrays may change afterwards."""
        self._waiting.append(record)

    def flush(self) -> None:
        """Write the waiting records as one batch; if that fails, the batch is kept for the next attempt."""
        if not self._unwritten:
            records = [self._waiting.popleft() for _ in range(len(self._waiting))]
            if records:
                batch = self._batch(records)
                self._unwritten, self._unwritten_rows = batch.serialize().to_pybytes(), batch.num_rows
        if self._unwritten:
            self.file.write(self._unwritten, self._unwritten_rows)
            self._unwritten = b""

    def finish(self) -> None:
        """Write the waiting records and the end mark of the stream; after a failure, call it again."""
        while self._unwritten or self._waiting:
            self.flush()
        if not self._ended:
            self.file.write(END_OF_STREAM)
            self._ended = True

    def _batch(self, records: Sequence[Any]) -> Any:
        columns = self._columns(self._layout, records)
        arrays = [_array(columns[field.name], field.type) for field in self._schema]
        return pa.RecordBatch.from_arrays(arrays, schema=self._schema)


def _array(values: Any, kind: Any) -> Any:
    return values if isinstance(values, pa.Array) else pa.array(values, kind)


@dataclass(frozen=True, slots=True)
class TableRead:
    """Result of reading a table: its whole batches, and the state of the rest of the file."""

    table: Any  # pyarrow.Table
    torn_bytes: int  # bytes after the last whole batch, without the end mark
    closed: bool  # the end mark is present and last


def read_table(path: Path, schema: Any) -> TableRead:
    """Read an Arrow stream up to its torn end; an absent file or one without a header counts as empty.

    The table also ends at a batch whose columns contradict each other, or whose `index` in rows.arrow does not continue
    that of the previous batch: a power cut can leave zeros instead of data. Columns that older files lack are null.
    Raises RecordingError if the file cannot be read at all or has other columns than `schema`.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        data = b""
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    source = pa.BufferReader(data)
    try:
        stream = pa.ipc.open_stream(source)
    except (pa.ArrowInvalid, OSError):
        return TableRead(schema.empty_table(), len(data), False)
    if not any(stream.schema.equals(generation) for generation in _generations(schema)):
        raise RecordingError(
            f"{path} has other columns than its manifest says: {_difference(stream.schema, schema)}"
        )
    batches, end = _whole_batches(stream, source, counted=path.stem == "rows")
    mark = data[end : end + len(END_OF_STREAM)] == END_OF_STREAM
    torn = len(data) - end - (len(END_OF_STREAM) if mark else 0)
    table = _completed(pa.Table.from_batches(batches, schema=stream.schema), schema)
    return TableRead(table, torn, mark and torn == 0)


def _completed(table: Any, schema: Any) -> Any:
    """Return the table with null columns in place of the columns of `schema` that it lacks."""
    for field in schema:
        if field.name not in table.column_names:
            table = table.append_column(field, pa.nulls(table.num_rows, field.type))
    return table.select(schema.names)


def _whole_batches(stream: Any, source: Any, *, counted: bool) -> tuple[list[Any], int]:
    batches: list[Any] = []
    end, rows = source.tell(), 0
    while True:
        try:
            batch = stream.read_next_batch()
            batch.validate(full=True)
        except (StopIteration, pa.ArrowInvalid, OSError):
            return batches, end
        if counted and not np.array_equal(batch.column("index"), np.arange(rows, rows + batch.num_rows)):
            return batches, end
        batches.append(batch)
        end, rows = source.tell(), rows + batch.num_rows


def _difference(actual: Any, expected: Any) -> str:
    strange = [str(field) for field in actual if field not in list(expected)]
    absent = [str(field) for field in expected if field not in list(actual)]
    return f"{', '.join(strange) or 'none'} in the place of {', '.join(absent) or 'another order'}"


def write_table(path: Path, table: Any) -> None:
    """Write a whole, closed Arrow stream to `path`, atomically."""
    batches = [batch.serialize().to_pybytes() for batch in table.to_batches()]
    write_atomic(path, b"".join([table.schema.serialize().to_pybytes(), *batches, END_OF_STREAM]))
