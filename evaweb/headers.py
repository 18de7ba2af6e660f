"""Headers of every answer: from where its parts may come, and that it is not to be kept."""

from __future__ import annotations

from typing import Any

from csp.constants import NONCE, NONE, SELF
from django.http import HttpRequest
from django.http.response import HttpResponseBase
from django.utils.deprecation import MiddlewareMixin

# The style elements that the viewer's script makes when it is loaded: an empty one, which it fills by rules, and that
# of its panel, which pages remove. tests/e2e/test_policy.py says what has changed where the script has.
_VIEWER_STYLES = (
    "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='",
    "'sha256-K7kXOYqP8pf16L5/PaLZ4u9Lt5q3nTyjCvyGtO/Af2k='",
)

DENY_ALL_POLICY = "default-src 'none'"  # the policy of what is no page and is answered without Django
PLAIN_PAGE = (
    "default-src 'none'; style-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
DEFAULT_HEADERS = [  # the headers of such an answer
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
        "connect-src": [SELF],  # its websockets as well
        "worker-src": [SELF],  # static/console/commands/beat.js
        "frame-src": [NONE],
        "object-src": [NONE],
        "base-uri": [NONE],
        "form-action": [SELF],
        "frame-ancestors": [NONE],
    }
}


def content_security_policy(videos: str = "") -> dict[str, Any]:
    """The policy of pages; `videos` is an origin from which they may play some, "" for none but ours."""
    directives = dict(_POLICY["DIRECTIVES"])
    return {"DIRECTIVES": directives | ({"media-src": [SELF, videos]} if videos else {})}


class HeadersMiddleware(MiddlewareMixin):
    """Outermost: whatever answers has the headers of BARE where it says nothing else, redirects and static files too.

    What is behind the login stays in no browser's cache: the next person at it may not be allowed to read it.
    """

    def process_response(self, request: HttpRequest, response: HttpResponseBase) -> HttpResponseBase:
        for name, value in DEFAULT_HEADERS:
            response.headers.setdefault(name.decode().title(), value.decode())
        return response
