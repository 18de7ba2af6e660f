"""Streaming downloads of rows in the requested format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from django.http import HttpRequest, StreamingHttpResponse

from evaweb.core.tabular_export import (
    Pages,
    csv_cell,
    iter_csv,
    iter_parquet,
)
from evaweb.serving.downloads import CSV, download

__all__ = ["Format", "Pages", "csv_cell", "csv_response", "table_response"]

Format = Literal["json", "csv", "parquet"]
PARQUET = "application/vnd.apache.parquet"


def table_response(
    request: HttpRequest, name: str, columns: Mapping[str, Any], pages: Pages, format: Format
) -> StreamingHttpResponse:
    """Return a download in `format`, csv or parquet; `columns` are the fields with their types."""
    if format == "parquet":
        return download(request, iter_parquet(columns, pages), f"{name}.parquet", PARQUET)
    return csv_response(request, name, list(columns), pages)


def csv_response(
    request: HttpRequest, name: str, columns: Sequence[str], pages: Pages
) -> StreamingHttpResponse:
    """Return a download `name`.csv with a header line, written page by page."""
    return download(request, iter_csv(columns, pages), f"{name}.csv", CSV)
