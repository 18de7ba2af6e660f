"""A TLS connection that one thread reads while another writes."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from runtime.core.tls import allow_two_threads
from tests.processes import PATIENCE_S, joined
from tests.runtime.policies.tls import self_signed

_MIB = bytes(range(256)) * 4096


class Watched:
    """An SSL object that notices when it is entered a second time before it was left."""

    def __init__(self, ssl_object: Any) -> None:
        self._ssl_object = ssl_object
        self._inside = threading.Lock()
        self.calls = 0
        self.overlaps = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ssl_object, name)

    def _entered(self, name: str, *arguments: Any) -> Any:
        if not self._inside.acquire(blocking=False):
            self.overlaps += 1
            raise AssertionError("entered twice")
        try:
            self.calls += 1
            return getattr(self._ssl_object, name)(*arguments)
        finally:
            self._inside.release()

    def read(self, *arguments: Any) -> Any:
        return self._entered("read", *arguments)

    def write(self, *arguments: Any) -> Any:
        return self._entered("write", *arguments)


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[tuple[ssl.SSLSocket, ssl.SSLSocket]]:
    """Both ends of one connection, each of them for two threads."""
    certificate, key = self_signed(tmp_path)
    serving = allow_two_threads(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
    serving.load_cert_chain(certificate, key)
    asking = allow_two_threads(ssl.create_default_context(cafile=str(certificate)))
    here, there = socket.socketpair()
    here.settimeout(PATIENCE_S)
    there.settimeout(PATIENCE_S)
    served: list[ssl.SSLSocket] = []
    thread = threading.Thread(target=lambda: served.append(serving.wrap_socket(there, server_side=True)))
    thread.start()
    client = asking.wrap_socket(here, server_hostname="localhost")
    joined(thread)
    with client, served[0]:
        yield client, served[0]


def test_its_ssl_object_is_never_entered_twice_while_both_directions_are_full(
    ends: tuple[ssl.SSLSocket, ssl.SSLSocket],
) -> None:
    watched = []
    for end in ends:
        watched.append(Watched(end._sslobj))  # type: ignore[attr-defined]
        end._sslobj = watched[-1]  # type: ignore[attr-defined]
    taken: dict[ssl.SSLSocket, bytes] = {}

    def take(end: ssl.SSLSocket) -> None:
        taken[end] = b""
        while len(taken[end]) < len(_MIB):
            taken[end] += end.recv(65536)

    threads = [threading.Thread(target=take, args=(end,)) for end in ends]
    threads += [threading.Thread(target=end.sendall, args=(_MIB,)) for end in ends]
    for thread in threads:
        thread.start()
    for thread in threads:
        joined(thread)
    assert [taken[end] == _MIB for end in ends] == [True, True]
    assert [found.overlaps for found in watched] == [0, 0]
    assert min(found.calls for found in watched) > len(_MIB) // 16384  # a record holds no more


def test_a_write_goes_out_while_a_read_waits(ends: tuple[ssl.SSLSocket, ssl.SSLSocket]) -> None:
    client, server = ends
    answers: list[bytes] = []
    reader = threading.Thread(target=lambda: answers.append(client.recv(16)))
    reader.start()
    client.sendall(b"asked")
    assert server.recv(16) == b"asked"
    server.sendall(b"answered")
    joined(reader)
    assert answers == [b"answered"]


def test_a_timeout_holds_for_a_read_and_for_a_write(ends: tuple[ssl.SSLSocket, ssl.SSLSocket]) -> None:
    client, _ = ends
    client.settimeout(0.01)
    assert client.gettimeout() == 0.01
    with pytest.raises(TimeoutError, match="gave nothing"):
        client.recv(16)
    with pytest.raises(TimeoutError, match="took nothing"):
        client.sendall(_MIB * 16)  # more than both sockets hold
    client.setblocking(False)
    with pytest.raises(ssl.SSLWantReadError):
        client.recv(16)


@pytest.mark.parametrize("end", [lambda client: client.shutdown(socket.SHUT_RDWR), ssl.SSLSocket.close])
def test_its_end_wakes_whoever_reads_and_whoever_writes(
    ends: tuple[ssl.SSLSocket, ssl.SSLSocket], end: Callable[[ssl.SSLSocket], None]
) -> None:
    client, _ = ends
    client.settimeout(None)
    got: list[bytes] = []
    ended = []

    def read() -> None:
        with contextlib.suppress(OSError):
            got.append(client.recv(16))
        ended.append("read")

    def write() -> None:
        with contextlib.suppress(OSError):
            client.sendall(_MIB * 16)
        ended.append("write")

    threads = [threading.Thread(target=step, daemon=True) for step in (read, write)]
    for thread in threads:
        thread.start()
    time.sleep(0.1)
    end(client)
    for thread in threads:
        joined(thread)
    assert sorted(ended) == ["read", "write"]
    assert got in ([b""], [])
