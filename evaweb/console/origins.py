"""Origin check of websockets."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from channels.security.websocket import WebsocketDenier

from evaweb.serving.origins import is_own_origin, scheme_of


class SameOrigin:
    """ASGI middleware that accepts websockets of our own pages only; others get 403."""

    def __init__(self, application: Callable[..., Awaitable[Any]]) -> None:
        self._application = application

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> Any:
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        if is_own_origin(headers.get(b"origin", ""), headers.get(b"host", ""), scheme_of(scope)):
            return await self._application(scope, receive, send)
        return await WebsocketDenier()(scope, receive, send)
