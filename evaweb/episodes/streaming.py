"""File responses over ASGI in pieces, with ranges for seeking in videos and small memory use.

Django's FileResponse does not support ranges, and under ASGI reads a whole file into memory.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import BinaryIO

from django.http import HttpRequest, HttpResponse, HttpResponseNotAllowed, StreamingHttpResponse
from django.http.response import HttpResponseBase

from evaweb.core.errors import NotFound
from evaweb.episodes.http_ranges import (
    Span,
    Unsatisfiable,
    Validators,
    not_modified,
    range_holds,
    requested_range,
)
from runtime.core.sentences import Pattern

_THIS_EPISODE_NOT_ON_THIS = Pattern(
    "episodes.streaming.this_episode_not_on_this",
    "{name} of this episode is not on this machine: {strerror}",
)

PIECE = 256 * 1024
# Daphne buffers everything it gets, however slow the client; a browser requests further parts of a video itself
# (section 15.3.7 of RFC 9110 lets a server send less than requested).
LONGEST_PART = 2 * 1024 * 1024


async def file_answer(
    request: HttpRequest, path: Path, content_type: str, name: str = ""
) -> HttpResponseBase:
    """Return the file, the requested range of it, or status 304.

    With a `name` it is a download. Neither `path` nor `name` may come from the client. Raises: NotFound if there is no
    such file.
    """
    if request.method not in ("GET", "HEAD"):
        return HttpResponseNotAllowed(["GET", "HEAD"])
    file = await asyncio.to_thread(_open, path)
    stat = os.fstat(file.fileno())
    answer = _answer(request, file, stat, content_type)
    if name:
        answer["Content-Disposition"] = f'attachment; filename="{name}"'
    if not isinstance(answer, StreamingHttpResponse):
        file.close()
    return answer


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise NotFound(_THIS_EPISODE_NOT_ON_THIS(name=path.name, strerror=error.strerror)) from None


def _answer(
    request: HttpRequest, file: BinaryIO, stat: os.stat_result, content_type: str
) -> HttpResponseBase:
    validators, headers = Validators.of(stat), request.headers
    common = {
        "Accept-Ranges": "bytes",
        "ETag": validators.etag,
        "Last-Modified": validators.last_modified,
    }
    if not_modified(headers.get("If-None-Match"), headers.get("If-Modified-Since"), validators):
        return HttpResponse(status=304, headers=common)
    span = None
    # Section 14.2: ranges are defined only for GET.
    if request.method == "GET" and range_holds(headers.get("If-Range"), validators):
        try:
            span = requested_range(headers.get("Range"), stat.st_size)
        except Unsatisfiable:
            return HttpResponse(status=416, headers={**common, "Content-Range": f"bytes */{stat.st_size}"})
    if span is None:
        whole = {**common, "Content-Type": content_type, "Content-Length": str(stat.st_size)}
        if request.method == "HEAD" or stat.st_size == 0:
            return HttpResponse(headers=whole)
        return StreamingHttpResponse(_pieces(file, Span(0, stat.st_size - 1)), headers=whole)
    span = Span(span.first, min(span.last, span.first + LONGEST_PART - 1))
    part = {
        **common,
        "Content-Type": content_type,
        "Content-Length": str(span.length),
        "Content-Range": f"bytes {span.first}-{span.last}/{stat.st_size}",
    }
    return StreamingHttpResponse(_pieces(file, span), status=206, headers=part)


async def _pieces(file: BinaryIO, span: Span) -> AsyncIterator[bytes]:
    with file:
        left = span.length
        offset = span.first
        while left:
            data = await asyncio.to_thread(os.pread, file.fileno(), min(PIECE, left), offset)
            if not data:
                raise OSError(
                    f"{file.name} ended {left} bytes early"
                )  # breaks the connection, so that the client notices
            left -= len(data)
            offset += len(data)
            yield data
