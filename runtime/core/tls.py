"""TLS sockets that one thread may read while another writes."""

from __future__ import annotations

import contextlib
import select
import socket
import ssl
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

_Result = TypeVar("_Result")


def allow_two_threads(context: ssl.SSLContext) -> ssl.SSLContext:
    """Let the sockets that `context` wraps be read by one thread while another writes; returns `context`.

    websockets' threaded connections do that with every socket, and OpenSSL does not allow it: one SSL object must
    never be entered twice at a time. What comes of it is "internal error", most often just after the handshake, when
    the reading thread takes the server's session tickets while the first request is written.
    """
    context.sslsocket_class = _TurnTakingSocket
    return context


class _TurnTakingSocket(ssl.SSLSocket):
    """Enters its SSL object from one thread at a time, and never waits for the network inside it.

    Its file descriptor does not block after the handshake; a timeout holds for the wait outside.
    """

    _turn: threading.Lock | None = None  # until the handshake is done
    _patience: float | None = None

    def do_handshake(self, block: bool = False) -> None:
        """Shake hands, within the timeout there is; then switch to waiting outside."""
        super().do_handshake(block)
        if self._turn is None:
            self._patience = super().gettimeout()
            super().settimeout(0.0)
            self._turn = threading.Lock()

    def settimeout(self, value: float | None) -> None:
        """As of every socket: seconds, 0 for no wait at all, None for no end."""
        if self._turn is None:
            super().settimeout(value)
        else:
            self._patience = value

    def setblocking(self, flag: bool) -> None:
        """As of every socket."""
        self.settimeout(None if flag else 0.0)

    def gettimeout(self) -> float | None:
        """What `settimeout` was given."""
        return super().gettimeout() if self._turn is None else self._patience

    def read(self, len: int = 1024, buffer: Any = None) -> Any:
        """What has arrived, in bytes; their number where they went to `buffer`. Nothing once it was shut down."""
        try:
            return self._in_turn(lambda: super(_TurnTakingSocket, self).read(len, buffer))
        except ValueError:  # what ssl says of a read that another thread's `shutdown` has ended
            if self._sslobj is not None:  # type: ignore[attr-defined]
                raise
            return b"" if buffer is None else 0

    def _real_close(self) -> None:
        """Wake whoever waits: a descriptor that is only closed wakes nobody who polls it."""
        with contextlib.suppress(OSError):
            super().shutdown(socket.SHUT_RDWR)
        super()._real_close()  # type: ignore[misc]

    def send(self, data: Any, flags: int = 0) -> int:
        """Send; returns how many bytes went."""
        return self._in_turn(lambda: super(_TurnTakingSocket, self).send(data, flags))

    def _in_turn(self, step: Callable[[], _Result]) -> _Result:
        if self._turn is None:
            return step()
        deadline = None if self._patience is None else time.monotonic() + self._patience
        refusal: ssl.SSLError
        while True:
            with self._turn:
                try:
                    return step()
                except ssl.SSLWantReadError as found:
                    wanted, refusal = select.POLLIN, found
                except ssl.SSLWantWriteError as found:
                    wanted, refusal = select.POLLOUT, found
            if self._patience == 0.0:
                raise refusal
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            poller = select.poll()
            poller.register(self, wanted)
            if not poller.poll(None if left is None else left * 1e3) and left is not None:
                raise TimeoutError("the TLS connection gave nothing, or took nothing, in time")
