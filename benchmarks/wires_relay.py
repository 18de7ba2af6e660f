"""TCP relay on loopback that counts the bytes in both directions; not used for timing."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from types import TracebackType

_PIECE = 1 << 20  # [bytes]
_QUIET_S = 0.1


class Relay:
    """Relay from `port` to the server at `target`, for any number of connections."""

    def __init__(self, target: int) -> None:
        self._target = target
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listening.getsockname()[1]
        self._counted = [
            0,
            0,
        ]  # to the server, from it; guarded by the lock
        self._lock = threading.Lock()
        self._ends: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept, daemon=True)]

    def __enter__(self) -> Relay:
        self._threads[0].start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close all connections, and wait for the threads."""
        with self._lock:
            ends = [self._listening, *self._ends]
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for end in ends:
            end.close()

    def settled(self) -> tuple[int, int]:
        """Return the bytes sent to and received from the server so far, after a tenth of a second without traffic."""
        before, now = None, self._now()
        while before != now:
            time.sleep(_QUIET_S)
            before, now = now, self._now()
        return now

    def _now(self) -> tuple[int, int]:
        with self._lock:
            return self._counted[0], self._counted[1]

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:  # closed
                return
            server = socket.create_connection(("127.0.0.1", self._target))
            with self._lock:
                self._ends += [client, server]
            for direction, source, sink in ((0, client, server), (1, server, client)):
                thread = threading.Thread(target=self._pass, args=(direction, source, sink), daemon=True)
                self._threads.append(thread)
                thread.start()

    def _pass(self, direction: int, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while piece := source.recv(_PIECE):
                sink.sendall(piece)
                with self._lock:
                    self._counted[direction] += len(piece)
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_WR)
