"""Rows as a download in the format that was asked for, written as they come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from django.http import HttpRequest, StreamingHttpResponse

from evaweb.downloads import CSV, download
from evaweb.tabular_export import Pages, cell, csv_lines, parquet_pieces

__all__ = ["Format", "Pages", "cell", "csv_answer", "table_answer"]

Format = Literal["json", "csv", "parquet"]
PARQUET = "application/vnd.apache.parquet"


def table_answer(
    request: HttpRequest, name: str, columns: Mapping[str, Any], pages: Pages, format: Format
) -> StreamingHttpResponse:
    """A download in `format`, csv or parquet; `columns` are the fields with their types."""
    if format == "parquet":
        return download(request, parquet_pieces(columns, pages), f"{name}.parquet", PARQUET)
    return csv_answer(request, name, list(columns), pages)


def csv_answer(
    request: HttpRequest, name: str, columns: Sequence[str], pages: Pages
) -> StreamingHttpResponse:
    """A download `name`.csv with a header line, written page by page as they come."""
    return download(request, csv_lines(columns, pages), f"{name}.csv", CSV)
