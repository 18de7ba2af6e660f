"""A stand-in for a chat server on loopback: real sockets, and every answer that a server can give."""

from __future__ import annotations

import json
import socketserver
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

Play = Callable[[Any], None]  # of a connection whose request was read


class ChatServer(socketserver.ThreadingTCPServer):
    """Reads each request whole, keeps it in `heard`, and answers as `play` does; `over` is set at its end."""

    daemon_threads = True

    def __init__(self, play: Play) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.play, self.heard, self.over = play, list[tuple[str, bytes]](), threading.Event()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/v1"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """What a client that hangs up does to a thread is no news."""


class _Handler(socketserver.StreamRequestHandler):
    server: ChatServer

    def handle(self) -> None:
        head, length = "", 0
        while (line := self.rfile.readline().decode("latin-1")).strip():
            head += line
            if line.lower().startswith("content-length:"):
                length = int(line.partition(":")[2])
        if head:
            self.server.heard.append((head, self.rfile.read(length)))
            with suppress(OSError):
                self.server.play(self)


@contextmanager
def serving(play: Play, tls: ssl.SSLContext | None = None) -> Iterator[ChatServer]:
    with ChatServer(play) as server:
        if tls is not None:
            server.socket = tls.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield server
        finally:
            server.over.set()
            server.shutdown()
            thread.join()


def http(status: int = 200, body: bytes = b"", *headers: str) -> Play:
    """An HTTP answer."""
    head = [f"HTTP/1.1 {status} Said", f"Content-Length: {len(body)}", *headers, "", ""]
    return lambda connection: connection.wfile.write("\r\n".join(head).encode() + body)


def message(content: str | None, finish: str | None = "stop", **more: Any) -> Play:
    """A completion that says `content`."""
    choice = {
        "index": 0,
        "message": {"role": "assistant", "content": content, **more},
        "finish_reason": finish,
    }
    return http(body=json.dumps({"id": "x", "model": "seer-2026-11-01", "choices": [choice]}).encode())


def said(*lines: tuple[Any, ...]) -> Play:
    """A completion with these (number, verdict, probability)."""
    names = ("number", "verdict", "probability")
    return message(json.dumps({"milestones": [dict(zip(names, line, strict=True)) for line in lines]}))
