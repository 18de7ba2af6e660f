"""Number of HTTP requests that are worked on at once: each has a thread and a connection to the database."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from evaweb.callers import SHARE, share_of
from evaweb.headers import BARE
from evaweb.lock_wait import hurried

_AT_ONCE = 32
_MOST_WAITING = 256
_COMMANDING = "/api/v1/stations/"  # what is posted there commands, takes or renews
_BUSY = b'{"error": "too many requests at once: try again in a few seconds"}'


class Slots:
    """An ASGI application in front of another one: requests take turns, and those that command do not wait long.

    A turn ends with the work on its request, whose thread and connection to the database nobody can end: not when its
    client hangs up. Nothing that stops a robot comes here: evaweb.api.door answers it before.
    """

    def __init__(self, application: Callable[..., Awaitable[Any]]) -> None:
        self._application = application
        self._turns = asyncio.Semaphore(_AT_ONCE)
        self._tasks: set[asyncio.Task[None]] = set()

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        if scope["path"] == "/healthz":
            await self._application(scope, receive, send)
        elif len(self._tasks) >= _AT_ONCE + _MOST_WAITING:
            await _refuse(send)
        else:
            task = asyncio.create_task(self._in_turn(scope, _Client(receive, send)))
            self._tasks.add(task)  # an event loop keeps none by itself
            task.add_done_callback(self._tasks.discard)
            await asyncio.shield(task)

    async def _in_turn(self, scope: dict[str, Any], client: _Client) -> None:
        await client.unless_gone(self._turns.acquire())
        try:
            await self._work(scope, client)
        finally:
            client.end()
            self._turns.release()

    async def _work(self, scope: dict[str, Any], client: _Client) -> None:
        SHARE.set(share_of(scope))  # of this task alone, and of the threads that work for it
        if scope["method"] == "POST" and scope["path"].startswith(_COMMANDING):
            with hurried():
                await self._application(scope, client.receive, client.send)
        else:
            await self._application(scope, client.receive, client.send)


class _Client:
    """Who sent a request. That they have hung up is told where more is sent, and not to who waits for a thread.

    Django, told of it at once, would leave its thread alone.
    """

    def __init__(self, receive: Any, send: Any) -> None:
        self._send = send
        self._body: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._gone = False
        self._waits: asyncio.Task[Any] | None = None
        self._listens = asyncio.create_task(self._listen(receive))

    async def _listen(self, receive: Any) -> None:
        whole = False
        while (message := await receive())["type"] != "http.disconnect":
            whole = not message.get("more_body", False)
            self._body.put_nowait(message)
        self._gone = True
        if not whole:
            self._body.put_nowait(message)
        if self._waits is not None:
            self._waits.cancel()

    async def unless_gone(self, turn: Coroutine[Any, Any, Any]) -> None:
        """Wait for `turn`; CancelledError where the client hangs up before it comes."""
        self._waits = asyncio.create_task(turn)
        if self._gone:
            self._waits.cancel()
        try:
            await self._waits
        finally:
            self._waits = None

    def end(self) -> None:
        """Nothing more is heard."""
        self._listens.cancel()

    async def receive(self) -> dict[str, Any]:
        """The next part of the body."""
        return await self._body.get()

    async def send(self, message: dict[str, Any]) -> None:
        """Send it; to who is gone nothing more is made, in the way in which Django hears of it while it answers."""
        if self._gone:
            raise asyncio.CancelledError
        await self._send(message)


async def _refuse(send: Any) -> None:
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(_BUSY))]
    headers += [(b"retry-after", b"3"), *BARE]
    await send({"type": "http.response.start", "status": 503, "headers": headers})
    await send({"type": "http.response.body", "body": _BUSY})
