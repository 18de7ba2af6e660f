"""Loads over HTTP: incomplete requests, passwords, long bodies, slow documents, exports."""

from __future__ import annotations

import asyncio
import http.client
import os
import socket
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from itertools import count
from urllib.parse import urlsplit

from benchmarks.attacks.target import Target
from benchmarks.estop_lab import GUESSED_ACCOUNT, PRESSED
from evaweb.accounts.roles import Role
from evaweb.lab.rest_client import RestClient
from evaweb.lab.stall_detection import DemoFailed

_CONNECTIONS, _LOGINS, _BODIES = 1100, 10, 4
_BODY, _CHUNK = 200_000_000, bytes(1_000_000)
_PARTS = 20_000
_EXPORTS, _PLANS, _TRIALS = 36, 40, 6000
_SLOW, _SLOW_POSTS = 250_000, 8
_HALF = b"POST /login/ HTTP/1.1\r\nHost: localhost\r\nContent-Le"
_ANSWER_S = 30.0
_OPENING_S = 5.0  # longest wait until all connections are open


def half_open(target: Target) -> Counter[str]:
    """Hold connections that send nothing or half a request; closed connections are reopened."""
    return asyncio.run(_half_open(target))


async def _half_open(target: Target) -> Counter[str]:
    opened: Counter[str] = Counter()
    tried = [asyncio.Event() for _ in range(target.part(_CONNECTIONS))]
    tries = [
        asyncio.create_task(_send_one(target, number, opened, event)) for number, event in enumerate(tried)
    ]
    with suppress(TimeoutError):
        async with asyncio.timeout(_OPENING_S):
            await asyncio.gather(*(event.wait() for event in tried))
    target.begun()
    await asyncio.to_thread(target.ended.wait)
    for task in tries:
        task.cancel()
    return opened


async def _send_one(target: Target, number: int, opened: Counter[str], tried: asyncio.Event) -> None:
    while True:
        try:
            reader, writer = await asyncio.open_connection(*target.address)
            opened["opened"] += 1
            if number % 2:
                writer.write(_HALF)
            tried.set()
            await reader.read()
            writer.close()
        except OSError:
            opened["refused"] += 1
        await asyncio.sleep(0.5)


def logins(target: Target) -> Counter[str]:
    """Log in from ten clients, repeatedly, every second time with a wrong password."""
    return again_and_again(target, _LOGINS, _login)


def _login(target: Target, number: int) -> str:
    password = target.passwords[GUESSED_ACCOUNT] if number % 2 else "not-the-password"
    RestClient(target.url).login(GUESSED_ACCOUNT, password)
    return "logged in"


def bodies(target: Target) -> Counter[str]:
    """Post 200 MB without a login, from four clients."""
    return again_and_again(target, _BODIES, _body)


def _body(target: Target, number: int) -> str:
    size = target.part(_BODY)
    head = (
        f"POST /api/v1/stations/{PRESSED}/estop HTTP/1.1\r\nHost: {target.address[0]}:{target.address[1]}\r\n"
    )
    head += f"Content-Type: application/json\r\nContent-Length: {size}\r\nConnection: close\r\n\r\n"
    with closing(socket.create_connection(target.address, _ANSWER_S)) as wire:
        wire.sendall(head.encode())
        for start in range(0, size, len(_CHUNK)):
            wire.sendall(_CHUNK[: size - start])
        return f"answered {wire.recv(64)[9:12].decode() or 'nothing'}"


def toml(target: Target) -> Counter[str]:
    """Import, as an administrator, a TOML file in which a key, or the name of a table, has twenty thousand parts."""
    visitor = target.visitor("admin")
    return again_and_again(target, 1, partial(_import, visitor))


def _import(visitor: RestClient, target: Target, number: int) -> str:
    name = ".".join("a" * target.part(_PARTS))
    text = f"{name} = 1\n" if number % 2 else f"[{name}]\n"
    answer = _posted_file(visitor, target, "/admin/plans/plan/import/", text)
    return f"answered {answer}"


def _posted_file(visitor: RestClient, target: Target, path: str, text: str) -> int:
    border, token = "end-of-part", visitor.csrf_token
    parts = (
        f'name="csrfmiddlewaretoken"\r\n\r\n{token}',
        f'name="file"; filename="lab.toml"\r\n\r\n{text}',
    )
    form_parts = "".join(f"--{border}\r\nContent-Disposition: form-data; {part}\r\n" for part in parts)
    headers = {"Content-Type": f"multipart/form-data; boundary={border}", "Cookie": visitor.cookies}
    with closing(http.client.HTTPConnection(*target.address, timeout=_ANSWER_S)) as connection:
        connection.request("POST", path, f"{form_parts}--{border}--\r\n".encode(), headers)
        return connection.getresponse().status


def exports(target: Target) -> Counter[str]:
    """Export 6,000 trials from 36 clients of one viewer."""
    _seed(target)
    cookies = target.visitor(Role.VIEWER).cookies

    def export(target: Target, number: int) -> str:
        with closing(http.client.HTTPConnection(*target.address, timeout=4 * _ANSWER_S)) as connection:
            connection.request("GET", "/api/v1/trials?format=csv", headers={"Cookie": cookies})
            answer = connection.getresponse()
            return f"answered {answer.status} with {len(answer.read()) >> 20} MB"

    return again_and_again(target, target.part(_EXPORTS), export)


def _seed(target: Target) -> None:
    """Fill the lab's database with as many evaluations as after years of use."""
    import django

    os.environ |= {"EVA_DATA_DIR": str(target.data), "DJANGO_SETTINGS_MODULE": "evaweb.settings"}
    django.setup()
    from benchmarks.results_seed import seed

    seed(target.part(_PLANS), target.part(_TRIALS))


def slow_json(target: Target) -> Counter[str]:
    """Post JSON that takes long to parse to the process for stops, without a login, from eight clients."""
    address = urlsplit(target.stops)

    def post(target: Target, number: int) -> str:
        with closing(http.client.HTTPConnection(address.netloc, timeout=_ANSWER_S)) as connection:
            headers = {"Content-Type": "application/json"}
            path = f"/api/v1/stations/{PRESSED}/estop"
            connection.request("POST", path, long_to_parse(target.part(_SLOW), number), headers)
            return f"answered {connection.getresponse().status}"

    return again_and_again(target, _SLOW_POSTS, post)


def long_to_parse(size: int, number: int) -> str:
    """Return about `size` bytes of JSON that take long to parse.

    For odd `number` they contain many objects, for even `number` long numbers.
    """
    part = "[]" if number % 2 else "9" * 4000
    return f'{{"type": "watch", "streams": [{",".join([part] * (size // (len(part) + 1)))}]}}'


def again_and_again(target: Target, at_once: int, ask: Callable[[Target, int], str]) -> Counter[str]:
    """Call `ask` repeatedly from `at_once` threads; return the number of answers by kind."""
    counts: Counter[str] = Counter()

    def requests() -> None:
        for number in count():
            try:
                counts[ask(target, number)] += 1
            except (DemoFailed, OSError, http.client.HTTPException) as fault:
                counts[type(fault).__name__] += 1
                target.ended.wait(0.05)

    for _ in range(at_once):
        threading.Thread(target=requests, daemon=True).start()
    target.begun()
    target.ended.wait()
    return counts
