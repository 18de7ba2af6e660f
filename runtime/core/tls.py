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
    """Make sockets wrapped by `context` usable by one reading and one writing thread; return `context`.

    The threaded connections of websockets use every socket with two threads, but OpenSSL forbids concurrent calls on
    one SSL object. The symptom is "internal error", most often just after the handshake, when the reader receives
    session tickets while the first request is written.
    """
    context.sslsocket_class = _TurnTakingSocket
    return context


class _TurnTakingSocket(ssl.SSLSocket):
    """TLS socket whose SSL object is used by one thread at a time, and never waits for the network inside.

    After the handshake the descriptor is non-blocking; timeouts apply to a poll outside the lock.
    """

    _turn: threading.Lock | None = None  # None until the handshake is done
    _patience: float | None = None

    def do_handshake(self, block: bool = False) -> None:
        """Perform the handshake within the current timeout, then switch to non-blocking mode."""
        super().do_handshake(block)
        if self._turn is None:
            self._patience = super().gettimeout()
            super().settimeout(0.0)
            self._turn = threading.Lock()

    def settimeout(self, value: float | None) -> None:
        """Set the timeout [s]; 0: do not wait, None: wait without limit."""
        if self._turn is None:
            super().settimeout(value)
        else:
            self._patience = value

    def setblocking(self, flag: bool) -> None:
        """Set blocking mode, with the meaning that it has for every socket."""
        self.settimeout(None if flag else 0.0)

    def gettimeout(self) -> float | None:
        """Return the timeout that `settimeout` set [s]."""
        return super().gettimeout() if self._turn is None else self._patience

    def read(self, len: int = 1024, buffer: Any = None) -> Any:
        """Return received bytes, or their number if they are read into `buffer`; empty or 0 after a shutdown."""
        try:
            return self._in_turn(lambda: super(_TurnTakingSocket, self).read(len, buffer))
        except ValueError:  # ssl raises it if another thread's `shutdown` ended the read
            if self._sslobj is not None:  # type: ignore[attr-defined]
                raise
            return b"" if buffer is None else 0

    def _real_close(self) -> None:
        """Shut down and close the socket; closing alone would not wake a thread that polls the descriptor."""
        with contextlib.suppress(OSError):
            super().shutdown(socket.SHUT_RDWR)
        super()._real_close()  # type: ignore[misc]

    def send(self, data: Any, flags: int = 0) -> int:
        """Send; return the number of bytes sent."""
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
                    events, refusal = select.POLLIN, found
                except ssl.SSLWantWriteError as found:
                    events, refusal = select.POLLOUT, found
            if self._patience == 0.0:
                raise refusal
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            poller = select.poll()
            poller.register(self, events)
            if not poller.poll(None if left is None else left * 1e3) and left is not None:
                raise TimeoutError("the TLS connection gave nothing, or took nothing, in time")
