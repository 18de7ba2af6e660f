"""Number of HTTP requests that are worked on at once: each has a thread and a connection to the database."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from evaweb.headers import BARE
from evaweb.lock_wait import hurried

_AT_ONCE = 32
_MOST_WAITING = 256
_COMMANDING = "/api/v1/stations/"  # what is posted there commands, takes or renews
_BUSY = b'{"error": "too many requests at once: try again in a few seconds"}'


class Slots:
    """An ASGI application in front of another one: requests take turns, and those that command do not wait long.

    Nothing that stops a robot comes here: evaweb.api.door answers it before.
    """

    def __init__(self, application: Callable[..., Awaitable[Any]]) -> None:
        self._application = application
        self._turns = asyncio.Semaphore(_AT_ONCE)
        self._waiting = 0

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        if scope["path"] == "/healthz":
            await self._application(scope, receive, send)
        elif self._waiting >= _MOST_WAITING:
            await _refuse(send)
        else:
            await self._in_turn(scope, receive, send)

    async def _in_turn(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        self._waiting += 1
        try:
            await self._turns.acquire()
        finally:
            self._waiting -= 1
        try:
            await self._work(scope, receive, send)
        finally:
            self._turns.release()

    async def _work(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        if scope["method"] == "POST" and scope["path"].startswith(_COMMANDING):
            with hurried():
                await self._application(scope, receive, send)
        else:
            await self._application(scope, receive, send)


async def _refuse(send: Any) -> None:
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(_BUSY))]
    headers += [(b"retry-after", b"3"), *BARE]
    await send({"type": "http.response.start", "status": 503, "headers": headers})
    await send({"type": "http.response.body", "body": _BUSY})
