"""Loads on the web's event loop, each part of them allowed or cheap: pings, handshakes, pages, REST."""

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
_PING = b"\x89\x80\x00\x00\x00\x00" * 500  # masked, of no bytes
_PATIENCE_S = 20.0
_BEGUN_S = 2.0  # at most, until each of a crowd has had an answer
_AGAIN_S = 0.1
_Then = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[object]]  # once it is answered


def pings(target: Target) -> Counter[str]:
    """Sockets of people who are logged in that ping as fast as they are read; those that are closed come again."""
    return asyncio.run(_crowd(target, _PINGS, _head(target, _socket(target)), _pings))


def handshakes(target: Target) -> Counter[str]:
    """Handshakes of websockets by nobody in particular, each closed as soon as it is answered."""
    head = _head(target, f"{_socket(target, 'made-up')}")
    return asyncio.run(_crowd(target, _HANDSHAKES, head, _no_more))


def pages(target: Target) -> Counter[str]:
    """The page of the station, opened by so many at once again and again."""
    head = _head(
        target, f"GET /stations/{PRESSED}/debug/ HTTP/1.1\r\n{_session(target)}Connection: close\r\n"
    )
    return asyncio.run(_crowd(target, _PAGES, head, _whole))


def rest_clients(target: Target) -> Counter[str]:
    """Clients of REST that ask for the station over and over."""
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
    """So many connections at once, each followed by another one; how often which answer came."""
    done: Counter[str] = Counter()
    answered = [asyncio.Event() for _ in range(target.part(size))]
    tasks = [asyncio.create_task(_over_and_over(target, head, then, done, one)) for one in answered]
    with suppress(TimeoutError):
        async with asyncio.timeout(_BEGUN_S):
            await asyncio.gather(*(one.wait() for one in answered))
    target.begun()
    await asyncio.to_thread(target.ended.wait)
    for task in tasks:
        task.cancel()
    return done


async def _over_and_over(
    target: Target, head: bytes, then: _Then, done: Counter[str], answered: asyncio.Event
) -> None:
    while True:
        try:
            async with asyncio.timeout(_PATIENCE_S):
                reader, writer = await asyncio.open_connection(*target.address)
                try:
                    writer.write(head)
                    status = (await reader.readexactly(12))[9:].decode()
                    answered.set()
                    await then(reader, writer)
                    done[status] += 1
                finally:
                    writer.close()
        except (OSError, asyncio.IncompleteReadError) as fault:
            done[type(fault).__name__] += 1
            await asyncio.sleep(_AGAIN_S)


async def _no_more(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """The answer is all."""


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
