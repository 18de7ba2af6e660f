"""Parquet files of rows: reading one episode from a file that may contain many, and writing a file of one episode."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.errors import RecordingError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

EPISODE = "episode_index"


def read_rows(path: Path, episode: int | None, left_out: Collection[str] = ()) -> pa.Table:
    """Return the rows of `episode`, or all rows if it is None, without the columns in `left_out`.

    Only row groups that may contain the episode are read. Raises: RecordingError, which names the file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        raise RecordingError(f"there is no {path}, though the metadata list it")
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            names = file.schema_arrow.names
            if len(set(names)) < len(names):
                duplicates = sorted({name for name in names if names.count(name) > 1})
                raise RecordingError(
                    f"{path} has more than one column named {', '.join(map(repr, duplicates))}"
                )
            columns = [name for name in names if name not in left_out] if left_out else None
            if episode is None:
                return file.read(columns=columns)
            if EPISODE not in names:
                raise RecordingError(
                    f"{path} holds several episodes but has no column {EPISODE}, only {names}"
                )
            table = file.read_row_groups(_groups(file.metadata, episode), columns=columns)
    except (OSError, pa.ArrowException) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    import pyarrow.compute as pc

    return table.filter(pc.equal(table.column(EPISODE), episode))


def column_array(table: pa.Table, name: str, width: int = 1) -> np.ndarray[Any, Any]:
    """Return column `name` as an array [N, W] with nested lists flattened; NaN if a row is null.

    Args:
        table: Rows of an episode.
        name: Name of the column.
        width: W if the column is null in all rows.

    Raises:
        RecordingError: Rows differ in length or are not numbers; the message names the column.
    """
    import pyarrow as pa

    column = table.column(name).combine_chunks()
    valid = column.is_valid().to_numpy(zero_copy_only=False)
    flat = column.drop_null()
    if len(column) and not len(flat):
        return np.full((len(column), width), np.nan)
    flat, _ = _flattened(flat, name)
    if pa.types.is_boolean(flat.type) and flat.null_count:
        flat = flat.cast(pa.int8())
    if not (
        pa.types.is_floating(flat.type) or pa.types.is_integer(flat.type) or pa.types.is_boolean(flat.type)
    ):
        raise RecordingError(f"{name!r} is stored as {column.type}, expected numbers")
    values = np.asarray(flat.to_numpy(zero_copy_only=False))
    present = values.reshape(valid.sum(), -1) if values.size else np.empty((valid.sum(), 0))
    if valid.all():
        return present
    rows = np.full((len(valid), present.shape[1]), np.nan)
    rows[valid] = present
    return rows


def row_shape(table: pa.Table, name: str) -> tuple[int, ...]:
    """Return the lengths of the nested lists in each row of column `name`, () for single values.

    Raises:
        RecordingError: Rows differ in length; the message names the column.
    """
    return _flattened(table.column(name).combine_chunks().drop_null(), name)[1]


def _flattened(flat: pa.Array, name: str) -> tuple[pa.Array, tuple[int, ...]]:
    import pyarrow.compute as pc

    shape: list[int] = []
    while is_list(flat.type):
        lengths = pc.unique(pc.list_value_length(flat)).to_pylist()
        if len(lengths) > 1:
            raise RecordingError(f"rows of {name!r} have lengths {sorted(lengths, key=str)}, expected one")
        shape += lengths
        flat = flat.flatten()
    return flat, tuple(shape)


def is_list(kind: pa.DataType) -> bool:
    """Return True if the type is a list, of fixed or variable length."""
    import pyarrow as pa

    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def write_table(table: pa.Table, path: Path) -> None:
    """Write `table` to `path`, with page checksums. Raises: RecordingError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        pq.write_table(table, path, write_page_checksum=True)
    except (OSError, pa.ArrowException) as error:
        raise RecordingError(f"{path} cannot be written: {error}") from error


def _groups(metadata: pq.FileMetaData, episode: int) -> list[int]:
    """Return the row groups that may contain the episode, by the statistics in the file."""
    chosen = []
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        columns = (group.column(k) for k in range(group.num_columns))
        column = next(column for column in columns if column.path_in_schema == EPISODE)
        statistics = column.statistics
        if statistics is None or not statistics.has_min_max or statistics.min <= episode <= statistics.max:
            chosen.append(number)
    return chosen
