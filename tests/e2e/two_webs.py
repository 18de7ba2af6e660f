"""A second web process of a lab, and a proxy that sends each connection to the other one than the last."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit

from tests.e2e.lab import ROOT
from tests.processes import PATIENCE_S, eventually


@contextmanager
def second_web(demo):
    """The child and its port; it ends with the block."""
    with (demo.folder / "second.log").open("a") as log:
        child = subprocess.Popen(
            [sys.executable, "manage.py", "serve", "--port", "0"],
            cwd=ROOT,
            env=demo.environment | {"PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
    assert child.stdout is not None
    try:
        said = child.stdout.readline()
        assert said, (demo.folder / "second.log").read_text()[-2000:]
        yield child, json.loads(said)["port"]
    finally:
        if child.poll() is None:
            os.kill(child.pid, signal.SIGTERM)
        child.wait(PATIENCE_S)
        child.stdout.close()


class Proxy:
    """Connections in turn to `ports`, past those that nobody listens at; `served` counts them by port."""

    def __init__(self, ports):
        self.ports, self.served = ports, dict.fromkeys(ports, 0)
        self._turn = 0

    async def lead(self, reader, writer):
        try:
            there = await self._opened()
            if there is not None:
                await asyncio.gather(_pour(reader, there[1]), _pour(there[0], writer))
        finally:
            writer.close()

    async def _opened(self):
        for _ in self.ports:
            port = self.ports[self._turn % len(self.ports)]
            self._turn += 1
            with suppress(OSError):
                found = await asyncio.open_connection("127.0.0.1", port)
                self.served[port] += 1
                return found
        return None


async def _pour(reader, writer):
    try:
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    except OSError:
        pass  # one end is gone: so is the other
    finally:
        writer.close()


@contextmanager
def in_turn(*urls_or_ports):
    """The proxy and its address."""
    ports = [urlsplit(one).port if isinstance(one, str) else one for one in urls_or_ports]
    proxy, loop, bound = Proxy(ports), asyncio.new_event_loop(), []

    async def listen():
        server = await asyncio.start_server(proxy.lead, "127.0.0.1", 0)
        bound.append(server.sockets[0].getsockname()[1])

    def run():
        loop.run_until_complete(listen())
        loop.run_forever()
        tasks = asyncio.all_tasks(loop)
        for task in tasks:
            task.cancel()
        if tasks:
            loop.run_until_complete(asyncio.wait(tasks))
        loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        eventually(lambda: bound, "the proxy listens")
        yield proxy, f"http://127.0.0.1:{bound[0]}"
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
