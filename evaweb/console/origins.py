"""Websockets only for our own pages: another site of the same machine, at another port, has the same cookies."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any
from urllib.parse import urlsplit

from channels.security.websocket import WebsocketDenier
from django.conf import settings


class SameOrigin:
    """Lets a websocket through where its Origin is the host and port it was asked of, or a trusted origin.

    The trusted ones are those of CSRF_TRUSTED_ORIGINS, without wildcards; all others are denied with 403.
    """

    def __init__(self, application: Callable[..., Awaitable[Any]]) -> None:
        self._application = application

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> Any:
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        origin = headers.get(b"origin", "")
        if _is_ours(origin, headers.get(b"host", "")):
            return await self._application(scope, receive, send)
        return await WebsocketDenier()(scope, receive, send)


def _is_ours(origin: str, host: str) -> bool:
    try:
        asked = urlsplit(origin).netloc
    except ValueError:
        return False
    return bool(asked) and (asked == host or origin in settings.CSRF_TRUSTED_ORIGINS)
