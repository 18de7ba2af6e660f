"""Loads on the web's event loop, each of which is allowed or cheap by itself: pings, handshakes, pages, REST."""

from __future__ import annotations

import asyncio
import base64
import os
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress

from benchmarks.attacks.target import Target
from benchmarks.estop_lab import PRESSED

_PINGS, _HANDSHAKES, _PAGES, _CLIENTS = 60, 3000, 600, 400
_PING = b"\x89\x80\x00\x00\x00\x00" * 500  # masked, empty payload
_PATIENCE_S = 20.0
_BEGUN_S = 2.0  # longest wait until each client of a crowd has had an answer
_AGAIN_S = 0.1
_Then = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[object]]  # called after the answer


def pings(target: Target) -> Counter[str]:
    """Send pings from logged-in websockets as fast as they are read; closed websockets are reopened."""
    return asyncio.run(_crowd(target, _PINGS, _head(target, _socket(target)), _pings))


def handshakes(target: Target) -> Counter[str]:
    """Open websockets without a valid login, each closed after its answer."""
    head = _head(target, f"{_socket(target, 'made-up')}")
    return asyncio.run(_crowd(target, _HANDSHAKES, head, _no_more))


def pages(target: Target) -> Counter[str]:
    """Request the station's page from many clients, repeatedly."""
    head = _head(
        target, f"GET /stations/{PRESSED}/debug/ HTTP/1.1\r\n{_session(target)}Connection: close\r\n"
    )
    return asyncio.run(_crowd(target, _PAGES, head, _whole))


def rest_clients(target: Target) -> Counter[str]:
    """Request the station's state over REST from many clients, repeatedly."""
    head = _head(
        target, f"GET /api/v1/stations/{PRESSED} HTTP/1.1\r\n{_session(target)}Connection: close\r\n"
    )
    return asyncio.run(_crowd(target, _CLIENTS, head, _whole))


def _session(target: Target, key: str = "") -> str:
    visitor = target.visitor("viewer")
    return f"Cookie: {f'{visitor.session_name}={key}' if key else visitor.cookies}\r\n"


def _socket(target: Target, key: str = "") -> str:
    nonce = base64.b64encode(os.urandom(16)).decode()
    return (
        f"GET /ws/stations/{PRESSED}?page=attack HTTP/1.1\r\n{_session(target, key)}Origin: {target.url}\r\n"
        f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {nonce}\r\n"
    )


def _head(target: Target, lines: str) -> bytes:
    return f"{lines}Host: {target.address[0]}:{target.address[1]}\r\n\r\n".encode()


async def _crowd(target: Target, size: int, head: bytes, then: _Then) -> Counter[str]:
    """Keep `size` connections open, and replace each that ends; return the number of answers by kind.

    On each connection `head` is sent; after the answer to it, `then` is called with the connection.
    """
    counts: Counter[str] = Counter()
    first_answers = [asyncio.Event() for _ in range(target.part(size))]
    tasks = [
        asyncio.create_task(_over_and_over(target, head, then, counts, event)) for event in first_answers
    ]
    with suppress(TimeoutError):
        async with asyncio.timeout(_BEGUN_S):
            await asyncio.gather(*(event.wait() for event in first_answers))
    target.begun()
    await asyncio.to_thread(target.ended.wait)
    for task in tasks:
        task.cancel()
    return counts


async def _over_and_over(
    target: Target, head: bytes, then: _Then, counts: Counter[str], first_answer: asyncio.Event
) -> None:
    while True:
        try:
            async with asyncio.timeout(_PATIENCE_S):
                reader, writer = await asyncio.open_connection(*target.address)
                try:
                    writer.write(head)
                    status = (await reader.readexactly(12))[9:].decode()
                    first_answer.set()
                    await then(reader, writer)
                    counts[status] += 1
                finally:
                    writer.close()
        except (OSError, asyncio.IncompleteReadError) as fault:
            counts[type(fault).__name__] += 1
            await asyncio.sleep(_AGAIN_S)


async def _no_more(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Do nothing with a connection after the answer to its first request."""


async def _whole(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read()


async def _pings(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    reading = asyncio.create_task(_read_all(reader))
    try:
        while not reading.done():
            writer.write(_PING)
            await writer.drain()
    finally:
        reading.cancel()


async def _read_all(reader: asyncio.StreamReader) -> None:
    while await reader.read(65536):
        pass
