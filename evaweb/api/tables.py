"""Rows as a download in the format that was asked for, written as they come."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from typing import Any, Literal, TypeVar

from asgiref.sync import sync_to_async
from django.core.handlers.asgi import ASGIRequest
from django.http import HttpRequest, StreamingHttpResponse

from evaweb.tabular_export import Pages, cell, csv_lines, parquet_pieces

__all__ = ["Format", "Pages", "cell", "csv_answer", "table_answer"]

Format = Literal["json", "csv", "parquet"]
Piece = TypeVar("Piece", str, bytes)
PARQUET = "application/vnd.apache.parquet"


def table_answer(
    request: HttpRequest, name: str, columns: Mapping[str, Any], pages: Pages, format: Format
) -> StreamingHttpResponse:
    """A download in `format`, csv or parquet; `columns` are the fields with their types."""
    if format == "parquet":
        return _download(request, parquet_pieces(columns, pages), f"{name}.parquet", PARQUET)
    return csv_answer(request, name, list(columns), pages)


def csv_answer(
    request: HttpRequest, name: str, columns: Sequence[str], pages: Pages
) -> StreamingHttpResponse:
    """A download `name`.csv with a header line, written page by page as they come."""
    return _download(request, csv_lines(columns, pages), f"{name}.csv", "text/csv; charset=utf-8")


def _download(
    request: HttpRequest, pieces: Iterator[Piece], name: str, content_type: str
) -> StreamingHttpResponse:
    content = _stepwise(pieces) if isinstance(request, ASGIRequest) else pieces
    return StreamingHttpResponse(
        content,
        content_type=content_type,
        headers={"Content-Disposition": f'attachment; filename="{name}"'},
    )


async def _stepwise(pieces: Iterator[Piece]) -> AsyncIterator[Piece]:
    """The pieces without blocking the event loop, and without collecting them first."""
    step = sync_to_async(next)
    while (piece := await step(pieces, None)) is not None:
        yield piece
