"""Which pages are our own: another site of the same machine, at another port, has the same cookies."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from django.conf import settings

_PORT = re.compile(r":([0-9]{1,5})$")


def is_own_origin(origin: str, host: str, scheme: str, web_port: int | None = None) -> bool:
    """True if pages of `origin` are the lab's, for a server that was asked as `host` over `scheme`.

    Ours are that scheme, host and port, and the trusted origins: CSRF_TRUSTED_ORIGINS, without wildcards. For a server
    beside the web it is `web_port` of that host too, over plain HTTP: behind a proxy all have one origin.
    """
    try:
        asked = urlsplit(origin)
        asked_of = asked.netloc
    except ValueError:
        return False
    if not asked_of:
        return False
    beside = (
        web_port is not None and asked.scheme == "http" and _parts(asked_of) == (_parts(host)[0], web_port)
    )
    same = (asked.scheme, asked_of) == (scheme, host)
    return beside or same or origin in settings.CSRF_TRUSTED_ORIGINS


def scheme_of(scope: Mapping[str, Any]) -> str:
    """ "https" or "http", as the browser of this request or websocket has it; of a proxy that is believed, its word."""
    if settings.SECURE_PROXY_SSL_HEADER is not None:
        meta, https = settings.SECURE_PROXY_SSL_HEADER
        wanted = meta.removeprefix("HTTP_").replace("_", "-").lower().encode()
        said = next((value for name, value in scope["headers"] if name.lower() == wanted), None)
        if said is not None:
            return "https" if said.decode("latin-1").split(",")[0].strip() == https else "http"
    return "https" if scope.get("scheme") in ("https", "wss") else "http"


def origin_at_port(host: str, web_port: int, port: int) -> str:
    """The origin beside the web's, over plain HTTP; "" where `host` is not the web's own port, but a proxy's."""
    name, asked = _parts(host)
    return f"http://{name}:{port}" if asked == web_port else ""


def _parts(host: str) -> tuple[str, int]:
    """Name and port of a Host header over plain HTTP."""
    found = _PORT.search(host)
    return (host[: found.start()], int(found[1])) if found else (host, 80)
