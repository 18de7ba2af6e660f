"""Export of rows as Parquet and as CSV that is safe to open in a spreadsheet."""

from __future__ import annotations

import csv
import io
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from enum import Enum
from itertools import islice
from typing import Any, Union, get_args, get_origin

_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")  # includes full-width characters
Pages = Iterable[Iterable[Mapping[str, Any]]]


def csv_cell(value: object) -> str:
    """Return a value as CSV text (see `plain`), escaped so that no spreadsheet takes it for a formula.

    A text that looks like a formula gets an apostrophe in front (OWASP, CSV injection), and so does one that looks
    already escaped: removing one apostrophe always restores the original.
    """
    text = plain(value)
    is_text = not isinstance(value, int | float | datetime)  # a negative number is not a formula
    return f"'{text}" if is_text and text.lstrip("'").startswith(_FORMULA) else text


def plain(value: object) -> str:
    """Return a value as text: "" for None, ISO 8601 for times."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, datetime):
        return value.isoformat()
    return repr(value) if isinstance(value, int | float) else str(value)


def iter_csv(columns: Sequence[str], pages: Pages) -> Iterator[str]:
    """Yield a header line, then one piece of CSV per page."""
    yield _lines([columns])
    for page in pages:
        yield _lines([csv_cell(row[column]) for column in columns] for row in page)


def in_pages(rows: Iterable[Mapping[str, Any]], size: int = 1000) -> Iterator[list[Mapping[str, Any]]]:
    """Yield the rows in lists of at most `size`."""
    left = iter(rows)
    while page := list(islice(left, size)):
        yield page


def _lines(rows: Iterable[Sequence[str]]) -> str:
    buffer = io.StringIO(newline="")
    csv.writer(buffer).writerows(rows)
    return buffer.getvalue()


def iter_parquet(columns: Mapping[str, Any], pages: Pages) -> Iterator[bytes]:
    """Yield a Parquet file with one row group per page; `columns` maps names to types such as `str` and `int | None`.

    Texts, enumerations and values of any other type become strings; times are UTC in microseconds.
    """
    import pyarrow as pa
    from pyarrow import parquet

    schema = pa.schema([(name, _arrow(hint)) for name, hint in columns.items()])
    textual = [name for name in columns if schema.field(name).type == pa.string()]
    sink = _Sink()
    with parquet.ParquetWriter(sink, schema, compression="zstd") as writer:
        for page in pages:
            rows = [{**row, **{name: _text(row[name]) for name in textual}} for row in page]
            if rows:
                writer.write_table(pa.Table.from_pylist(rows, schema))
                yield sink.drain()
    yield sink.drain()


def _arrow(hint: Any) -> Any:
    import pyarrow as pa

    kinds = [kind for kind in get_args(hint) if kind is not type(None)] if _is_union(hint) else [hint]
    kind = kinds[0] if len(kinds) == 1 else str
    arrow_types = {
        bool: pa.bool_(),
        int: pa.int64(),
        float: pa.float64(),
        datetime: pa.timestamp("us", tz="UTC"),
    }
    return arrow_types.get(kind, pa.string())


def _is_union(hint: Any) -> bool:
    return get_origin(hint) in (Union, types.UnionType)


def _text(value: object) -> str | None:
    if value is None:
        return None
    return str(value.value) if isinstance(value, Enum) else str(value)


class _Sink(io.RawIOBase):
    """Write-only buffer for the Parquet writer, which never seeks."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._at = 0

    def writable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def write(self, data: Any) -> int:
        piece = bytes(data)
        self._pieces.append(piece)
        self._at += len(piece)
        return len(piece)

    def drain(self) -> bytes:
        """Return everything written since the last call."""
        whole, self._pieces = b"".join(self._pieces), []
        return whole
