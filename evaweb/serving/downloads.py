"""Downloads that are generated piece by piece."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from typing import TypeVar

from asgiref.sync import sync_to_async
from django.core.handlers.asgi import ASGIRequest
from django.http import HttpRequest, StreamingHttpResponse
from django.utils.http import content_disposition_header

CSV = "text/csv; charset=utf-8"
Piece = TypeVar("Piece", str, bytes)


def download(
    request: HttpRequest, pieces: Iterator[Piece], name: str, content_type: str
) -> StreamingHttpResponse:
    """Return a streaming response that a browser saves as `name`."""
    content = _stepwise(pieces) if isinstance(request, ASGIRequest) else pieces
    return StreamingHttpResponse(
        content,
        content_type=content_type,
        headers={"Content-Disposition": content_disposition_header(True, name) or "attachment"},
    )


async def _stepwise(pieces: Iterator[Piece]) -> AsyncIterator[Piece]:
    """Yield the pieces without blocking the event loop and without collecting them first."""
    step = sync_to_async(next)
    while (piece := await step(pieces, None)) is not None:
        yield piece
