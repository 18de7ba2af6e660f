"""Default headers of all responses: content security policy and no caching."""

from __future__ import annotations

from typing import Any

from csp.constants import NONCE, NONE, SELF
from django.http import HttpRequest
from django.http.response import HttpResponseBase
from django.utils.deprecation import MiddlewareMixin

# Style elements that the viewer's script inserts when it is loaded: an empty one, filled by rules, and the one
# of its panel, which pages remove. tests/e2e/test_policy.py names the difference if the script changes.
_VIEWER_STYLES = (
    "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='",
    "'sha256-K7kXOYqP8pf16L5/PaLZ4u9Lt5q3nTyjCvyGtO/Af2k='",
)

DENY_ALL_POLICY = "default-src 'none'"  # policy of responses other than pages, made without Django
PLAIN_PAGE = (
    "default-src 'none'; style-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
DEFAULT_HEADERS = [  # headers of such a response
    (b"cache-control", b"no-store"),
    (b"content-security-policy", DENY_ALL_POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
]

_POLICY: dict[str, Any] = {
    "DIRECTIVES": {
        "default-src": [SELF],
        "script-src": [SELF],
        "style-src": [SELF, NONCE, *_VIEWER_STYLES],
        "img-src": [SELF, "data:"],
        "connect-src": [SELF],  # includes websockets
        "worker-src": [SELF],  # static/console/commands/beat.js
        "frame-src": [NONE],
        "object-src": [NONE],
        "base-uri": [NONE],
        "form-action": [SELF],
        "frame-ancestors": [NONE],
    }
}


def content_security_policy(videos: str = "") -> dict[str, Any]:
    """Return the policy of pages; `videos` is a further origin of videos, "" if there is none."""
    directives = dict(_POLICY["DIRECTIVES"])
    return {"DIRECTIVES": directives | ({"media-src": [SELF, videos]} if videos else {})}


class HeadersMiddleware(MiddlewareMixin):
    """Outermost middleware: sets DEFAULT_HEADERS that a response lacks, also on redirects and static files.

    Pages behind the login stay out of the browser's cache: its next user may not be allowed to read them.
    """

    def process_response(self, request: HttpRequest, response: HttpResponseBase) -> HttpResponseBase:
        for name, value in DEFAULT_HEADERS:
            response.headers.setdefault(name.decode().title(), value.decode())
        return response
