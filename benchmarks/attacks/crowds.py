"""Loads on the web's event loop, each part of them allowed or cheap: pings, handshakes, pages, REST."""

from __future__ import annotations

import asyncio
import base64
import os
from collections import Counter
from collections.abc import Awaitable, Callable
from functools import partial

from benchmarks.attacks.target import Target
from benchmarks.estop_lab import PRESSED

_PINGS, _HANDSHAKES, _PAGES, _CLIENTS = 60, 3000, 600, 400
_PING = b"\x89\x80\x00\x00\x00\x00" * 500  # masked, of no bytes
_PATIENCE_S = 20.0
_BEGUN_S = 2.0
_AGAIN_S = 0.1
_Ask = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[str]]


def pings(target: Target) -> Counter[str]:
    """Sockets of people who are logged in that ping as fast as they are read; those that are closed come again."""
    return asyncio.run(_crowd(target, _PINGS, partial(_pings, _head(target, _socket(target)))))


def handshakes(target: Target) -> Counter[str]:
    """Handshakes of websockets by nobody in particular, each closed as soon as it is answered."""
    head = _head(target, f"{_socket(target, 'made-up')}")
    return asyncio.run(_crowd(target, _HANDSHAKES, partial(_answered, head)))


def pages(target: Target) -> Counter[str]:
    """The page of the station, opened by so many at once again and again."""
    head = _head(
        target, f"GET /stations/{PRESSED}/debug/ HTTP/1.1\r\n{_session(target)}Connection: close\r\n"
    )
    return asyncio.run(_crowd(target, _PAGES, partial(_whole, head)))


def rest_clients(target: Target) -> Counter[str]:
    """Clients of REST that ask for the station over and over."""
    head = _head(
        target, f"GET /api/v1/stations/{PRESSED} HTTP/1.1\r\n{_session(target)}Connection: close\r\n"
    )
    return asyncio.run(_crowd(target, _CLIENTS, partial(_whole, head)))


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


async def _crowd(target: Target, size: int, ask: _Ask) -> Counter[str]:
    """So many connections at once, each followed by another one; how often which answer came."""
    done: Counter[str] = Counter()
    tasks = [asyncio.create_task(_over_and_over(target, ask, done)) for _ in range(target.part(size))]
    await asyncio.sleep(_BEGUN_S)
    target.begun()
    await asyncio.to_thread(target.ended.wait)
    for task in tasks:
        task.cancel()
    return done


async def _over_and_over(target: Target, ask: _Ask, done: Counter[str]) -> None:
    while True:
        try:
            async with asyncio.timeout(_PATIENCE_S):
                reader, writer = await asyncio.open_connection(*target.address)
                try:
                    done[await ask(reader, writer)] += 1
                finally:
                    writer.close()
        except (OSError, asyncio.IncompleteReadError) as fault:
            done[type(fault).__name__] += 1
            await asyncio.sleep(_AGAIN_S)


async def _answered(head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
    writer.write(head)
    return (await reader.readexactly(12))[9:].decode()


async def _whole(head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
    status = await _answered(head, reader, writer)
    await reader.read()
    return status


async def _pings(head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
    await _answered(head, reader, writer)
    reading = asyncio.create_task(_read_all(reader))
    try:
        while not reading.done():
            writer.write(_PING)
            await writer.drain()
    finally:
        reading.cancel()
    return "closed"


async def _read_all(reader: asyncio.StreamReader) -> None:
    while await reader.read(65536):
        pass
