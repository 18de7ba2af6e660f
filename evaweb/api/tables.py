"""Rows as CSV that a spreadsheet can open without being told what to do by a cell."""

from __future__ import annotations

import csv
import io
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, Literal

from asgiref.sync import sync_to_async
from django.core.handlers.asgi import ASGIRequest
from django.http import HttpRequest, StreamingHttpResponse

Format = Literal["json", "csv"]
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def csv_answer(
    request: HttpRequest, name: str, columns: Sequence[str], pages: Iterable[Iterable[Mapping[str, Any]]]
) -> StreamingHttpResponse:
    """A download `name`.csv with a header line, written page by page as they come."""
    pieces = _pieces(columns, pages)
    content = _stepwise(pieces) if isinstance(request, ASGIRequest) else pieces
    return StreamingHttpResponse(
        content,
        content_type="text/csv; charset=utf-8",
        headers={"Content-Disposition": f'attachment; filename="{name}.csv"'},
    )


def cell(value: object) -> str:
    """A value as it stands in CSV: None is empty, times are ISO 8601, and no text is a formula.

    A text that a spreadsheet would take for a formula gets an apostrophe in front (OWASP, CSV injection).
    """
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, int | float):
        return repr(value)
    text = str(value)
    return f"'{text}" if text.startswith(_FORMULA) else text


def _pieces(columns: Sequence[str], pages: Iterable[Iterable[Mapping[str, Any]]]) -> Iterator[str]:
    yield _lines([columns])
    for page in pages:
        yield _lines([cell(row[column]) for column in columns] for row in page)


def _lines(rows: Iterable[Sequence[str]]) -> str:
    buffer = io.StringIO(newline="")
    csv.writer(buffer).writerows(rows)
    return buffer.getvalue()


async def _stepwise(pieces: Iterator[str]) -> AsyncIterator[str]:
    """The pieces without blocking the event loop, and without collecting them first."""
    step = sync_to_async(next)
    while (piece := await step(pieces, None)) is not None:
        yield piece
