"""Refusals of requests before Django is involved, in Django's format: JSON, or an HTML page."""

from __future__ import annotations

import json
import re
from http import HTTPStatus
from typing import Any
from urllib.parse import unquote_to_bytes

import daphne.server  # noqa: F401  first: it decides which reactor there is

# isort: split
from django.template.loader import render_to_string
from twisted.web.http import HTTPChannel

from evaweb.serving.headers import DEFAULT_HEADERS, PLAIN_PAGE

_REST = b"/api/"
_STOPS = re.compile(rb"/api/v1/stations/[^/]+/(estop|commands)")
_HEADERS_OF_A_STOP = (
    80 * 1024
)  # [bytes] other programs on the same host may make a browser send 64 KiB of cookies
Headers = list[tuple[bytes, bytes]]


def is_stop(path: bytes) -> bool:
    """Return True if a request to that address may stop a robot."""
    return _STOPS.fullmatch(path) is not None


def refusal(status: int, sentence: str, path: bytes) -> tuple[Headers, bytes]:
    """Return headers and body of a refusal of a request to `path`."""
    if path.startswith(_REST):
        kind, body, policy = "application/json", json.dumps({"error": sentence}), {}
    else:
        kind, policy = "text/html; charset=utf-8", {b"content-security-policy": PLAIN_PAGE.encode()}
        body = render_to_string("unavailable.html", {"sentence": sentence, "status": status})
    content = body.encode()
    described = {
        b"content-type": kind.encode(),
        b"content-length": b"%d" % len(content),
        **dict(DEFAULT_HEADERS),
        **policy,
    }
    return list(described.items()), content


def raw_refusal(status: int, sentence: str, path: bytes) -> bytes:
    """Return the refusal as bytes of an HTTP response that closes its connection."""
    headers, content = refusal(status, sentence, path)
    lines = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}".encode()]
    lines += [name.title() + b": " + value for name, value in headers]
    return b"\r\n".join([*lines, b"Connection: close", b"", content])


class Channel(HTTPChannel):  # type: ignore[misc]
    """Twisted's HTTP channel with an answer to every malformed request.

    Twisted itself would close the connection without an answer, or give no reason.
    """

    def lineReceived(self, line: bytes) -> None:
        """Receive the request line or a header; requests that may stop a robot may have longer headers."""
        is_first = not self._receivedHeaderSize
        super().lineReceived(line)
        if is_first and is_stop(unquote_to_bytes(getattr(self, "_path", b"").partition(b"?")[0])):
            self.MAX_LENGTH = self.totalHeadersSize = _HEADERS_OF_A_STOP

    def allContentReceived(self) -> None:
        """Restore the default limits for the next request of the connection."""
        super().allContentReceived()
        self.MAX_LENGTH, self.totalHeadersSize = Channel.MAX_LENGTH, Channel.totalHeadersSize

    def lineLengthExceeded(self, line: bytes) -> None:
        """Refuse a request line or a header that is too long."""
        if self._receivedHeaderSize:
            self._refuse(431, f"a header is too long; allowed: {self.MAX_LENGTH} bytes", self._path)
        else:
            path = line[: self.MAX_LENGTH].partition(b" ")[2]
            self._refuse(414, f"the address is too long; allowed: {self.MAX_LENGTH} bytes", path)

    def _respondToBadRequestAndDisconnect(self) -> None:
        path = getattr(self, "_path", b"")
        if self._receivedHeaderSize > self.totalHeadersSize or self._receivedHeaderCount > self.maxHeaders:
            most = f"{self.maxHeaders} headers, {self.totalHeadersSize} bytes in all"
            self._refuse(431, f"the headers are too long; allowed: {most}", path)
        else:
            self._refuse(400, "this is no request of HTTP", path)

    def _refuse(self, status: int, sentence: str, path: Any) -> None:
        self.transport.write(raw_refusal(status, sentence, bytes(path)))
        self.loseConnection()
