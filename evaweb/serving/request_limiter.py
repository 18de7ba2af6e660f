"""Limit on concurrent HTTP requests: each needs a thread and a database connection."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine, Hashable
from contextlib import AsyncExitStack
from typing import Any

from evaweb.accounts.client_addresses import SHARE, client_key
from evaweb.core.lock_wait import short_lock_wait
from evaweb.serving.headers import DEFAULT_HEADERS

_AT_ONCE = 32
_MOST_WAITING = 256
_OF_ONE, _OF_ADDRESS = 8, 24  # concurrent requests of one login or token; of one address with all its users
_WAITING_OF_ONE = 64
_EXPORTS = 2  # concurrent exports; each occupies a CPU core for seconds
_EXPORTED = (b"format=csv", b"format=parquet")
_COMMANDING = "/api/v1/stations/"  # path of POSTs that send commands and acquire or renew leases
_BUSY = b'{"error": "too many requests at once: try again in a few seconds"}'


class RequestLimiter:
    """ASGI middleware that queues requests and bounds the lock waits of requests that command a station.

    Each login and each address has a bounded share, so that a client with many requests leaves slots for the others.

    A slot is released when the work on its request ends, not when its client hangs up: the thread and its database
    connection cannot be interrupted. Requests that stop a robot never get here: evaweb.api.stop_gateway answers them
    first.
    """

    def __init__(self, application: Callable[..., Awaitable[Any]]) -> None:
        self._application = application
        self._turns = asyncio.Semaphore(_AT_ONCE)
        self._exports = asyncio.Semaphore(_EXPORTS)
        self._people, self._addresses = _Shares(_OF_ONE), _Shares(_OF_ADDRESS)
        self._tasks: set[asyncio.Task[None]] = set()

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        if scope["path"] == "/healthz":
            await self._application(scope, receive, send)
            return
        address = client_key(scope)
        person = address, _login_of(scope)
        if (
            len(self._tasks) >= _AT_ONCE + _MOST_WAITING
            or self._people.asking[person] >= _OF_ONE + _WAITING_OF_ONE
        ):
            await _refuse(send)
        else:
            shares = self._people.acquire_share(person), self._addresses.acquire_share(address)
            task = asyncio.create_task(self._in_turn(scope, _Client(receive, send), *shares))
            task.add_done_callback(
                lambda _: (self._people.answered(person), self._addresses.answered(address))
            )
            self._tasks.add(task)  # strong reference: the event loop has only weak ones
            task.add_done_callback(self._tasks.discard)
            await asyncio.shield(task)

    async def _in_turn(
        self, scope: dict[str, Any], client: _Client, own: asyncio.Semaphore, of_all: asyncio.Semaphore
    ) -> None:
        exports = (self._exports,) if _is_export(scope) else ()
        async with AsyncExitStack() as stack:
            # From the narrowest share to the global one: a request that waits for its own share holds no global slot.
            for turns in (own, *exports, of_all, self._turns):
                await client.unless_gone(turns.acquire())
                stack.callback(turns.release)
            stack.callback(client.end)
            await self._work(scope, client)

    async def _work(self, scope: dict[str, Any], client: _Client) -> None:
        SHARE.set(client_key(scope))  # context of this task and of the threads that work for it
        if scope["method"] == "POST" and scope["path"].startswith(_COMMANDING):
            with short_lock_wait():
                await self._application(scope, client.receive, client.send)
        else:
            await self._application(scope, client.receive, client.send)


class _Shares:
    """Semaphores with at most `most` permits per name; `asking` counts the holders and waiters of each name."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._of: dict[Hashable, asyncio.Semaphore] = {}
        self.asking: Counter[Hashable] = Counter()

    def acquire_share(self, name: Hashable) -> asyncio.Semaphore:
        """Return the semaphore of `name` and count one request for it; call `answered` when the request ends."""
        self.asking[name] += 1
        return self._of.setdefault(name, asyncio.Semaphore(self._most))

    def answered(self, name: Hashable) -> None:
        """End one request of `name`; drop its semaphore after the last one."""
        self.asking[name] -= 1
        if not self.asking[name]:
            del self.asking[name], self._of[name]


def _is_export(scope: dict[str, Any]) -> bool:
    query = scope.get("query_string", b"").lower()
    return scope["path"].endswith(".csv") or any(word in query for word in _EXPORTED)


def _login_of(scope: dict[str, Any]) -> bytes:
    """Return the credentials of a request, unverified.

    A client does not get more slots by inventing credentials, because the limit per address holds as well.
    """
    return b"".join(value for name, value in scope["headers"] if name in (b"authorization", b"cookie"))


class _Client:
    """Receiver and sender of one request. A hang-up is reported only when the application sends.

    If Django learned of a hang-up at once, it would abandon the thread of the request, which would keep running outside
    the limit.
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
        """Await the coroutine `turn`, with which the request waits for its turn.

        Raises:
            CancelledError: If the client hangs up first.
        """
        self._waits = asyncio.create_task(turn)
        if self._gone:
            self._waits.cancel()
        try:
            await self._waits
        finally:
            self._waits = None

    def end(self) -> None:
        """Stop reading from the client."""
        self._listens.cancel()

    async def receive(self) -> dict[str, Any]:
        """Return the next message of the request body."""
        return await self._body.get()

    async def send(self, message: dict[str, Any]) -> None:
        """Send `message`. Raises: CancelledError if the client is gone, which ends the response as Django expects."""
        if self._gone:
            raise asyncio.CancelledError
        await self._send(message)


async def _refuse(send: Any) -> None:
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(_BUSY))]
    headers += [(b"retry-after", b"3"), *DEFAULT_HEADERS]
    await send({"type": "http.response.start", "status": 503, "headers": headers})
    await send({"type": "http.response.body", "body": _BUSY})
