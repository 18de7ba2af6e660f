"""Compression of pages and of numbers for pages; files and videos are sent as they are."""

from __future__ import annotations

from django.http import HttpRequest
from django.http.response import HttpResponseBase
from django.middleware.gzip import GZipMiddleware

_SHRINKING = ("text/html", "text/csv", "application/json", "application/octet-stream")


class CompressionMiddleware(GZipMiddleware):
    """Compresses responses that are complete in memory and of a type that shrinks.

    Streams stay as they are: videos and downloads need their length, ranges and pace.
    """

    def process_response(self, request: HttpRequest, response: HttpResponseBase) -> HttpResponseBase:
        kind = response.headers.get("Content-Type", "").partition(";")[0]
        if response.streaming or kind not in _SHRINKING:
            return response
        return super().process_response(request, response)
