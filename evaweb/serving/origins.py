"""Check of request origins: another site on the same machine, at another port, receives the same cookies."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

from channels.security.websocket import WebsocketDenier
from django.conf import settings

_PORT = re.compile(r":([0-9]{1,5})$")


def is_own_origin(origin: str, host: str, scheme: str, web_port: int | None = None) -> bool:
    """Return True if pages of `origin` belong to the lab, for a request with Host `host` over `scheme`.

    Pages belong to the lab if their origin has the same scheme and host as the request, or is in CSRF_TRUSTED_ORIGINS
    (without wildcards). A server that runs next to the web passes the web's port as `web_port`: pages at that port of
    the same host, over plain HTTP, belong to the lab too. Behind a proxy `web_port` is not needed, because web and
    server have the same origin there.
    """
    try:
        parsed = urlsplit(origin)
        netloc = parsed.netloc
    except ValueError:
        return False
    if not netloc:
        return False
    at_web_port = (
        web_port is not None and parsed.scheme == "http" and _parts(netloc) == (_parts(host)[0], web_port)
    )
    same = (parsed.scheme, netloc) == (scheme, host)
    return at_web_port or same or origin in settings.CSRF_TRUSTED_ORIGINS


def scheme_of(scope: Mapping[str, Any]) -> str:
    """Return "https" or "http" as the browser used it; a trusted proxy's header takes precedence."""
    if settings.SECURE_PROXY_SSL_HEADER is not None:
        meta, https = settings.SECURE_PROXY_SSL_HEADER
        header = meta.removeprefix("HTTP_").replace("_", "-").lower().encode()
        scheme = next((value for name, value in scope["headers"] if name.lower() == header), None)
        if scheme is not None:
            return "https" if scheme.decode("latin-1").split(",")[0].strip() == https else "http"
    return "https" if scope.get("scheme") in ("https", "wss") else "http"


def origin_at_port(host: str, web_port: int, port: int) -> str:
    """Return the plain-HTTP origin at `port` of the host that the browser used.

    Returns "" if the port in `host` is not the web server's own port `web_port`: the request then came through a proxy.
    """
    name, host_port = _parts(host)
    return f"http://{name}:{port}" if host_port == web_port else ""


def _parts(host: str) -> tuple[str, int]:
    """Return name and port of a Host header over plain HTTP."""
    match = _PORT.search(host)
    return (host[: match.start()], int(match[1])) if match else (host, 80)


class SameOrigin:
    """ASGI middleware that accepts websockets of our own pages only; others get 403."""

    def __init__(self, application: Callable[..., Awaitable[Any]]) -> None:
        self._application = application

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> Any:
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        if is_own_origin(headers.get(b"origin", ""), headers.get(b"host", ""), scheme_of(scope)):
            return await self._application(scope, receive, send)
        return await WebsocketDenier()(scope, receive, send)
