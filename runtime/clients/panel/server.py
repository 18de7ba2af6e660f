"""HTTP server of the panel: few connections, each with a deadline, and always room for a new one.

Independent of stations. Each connection has a thread; if there are too many, the oldest that is not pressing the e-stop
is cut off for the newest, so that slow or greedy clients cannot block the e-stop.
"""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any

from runtime.clients.panel.settings import PanelPlace
from runtime.core.errors import ConfigurationError, TransportError

log = logging.getLogger(__name__)
REQUEST_S = 10.0  # for one request, from its first byte to the end of the answer, and between two [s]
MOST, MOST_OF_ONE, MOST_THREADS = 32, 12, 64
_LOOK_S = 0.25
_RENEWED_S = 30.0  # between two checks of the certificate's files [s]


@dataclass(eq=False, slots=True)
class Connection:
    """Connection with its source address, its deadline [s], and whether it is pressing the e-stop now."""

    socket: socket.socket
    source: str
    until: float
    presses: bool = False
    gone: bool = False  # cut off, but its thread has not ended yet

    def cut(self) -> None:
        """Shut the connection down; its thread then closes it.

        The shutdown of the plain socket is called, because the connection's thread may be executing a method of the TLS
        socket.
        """
        self.gone = True
        with suppress(OSError):
            socket.socket.shutdown(self.socket, socket.SHUT_RDWR)


class PanelServer(ThreadingHTTPServer):
    """Server at the panel's address; call `turn` repeatedly. Raises: TransportError if it cannot listen."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 1024  # a flood of waiting connections does not delay others by a second
    timeout = _LOOK_S

    def __init__(self, place: PanelPlace, handler: type[BaseHTTPRequestHandler]) -> None:
        self.place = place
        self._tls = place.context()
        self._written, self._looked_at_files = place.written, time.monotonic()
        self._connections: list[Connection] = []
        self._serving = 0
        self._lock = threading.Lock()
        self.address_family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
        try:
            super().__init__((place.host, place.port), handler)
        except OSError as error:
            raise TransportError(f"cannot listen at {place.host}:{place.port}: {error.strerror}") from None

    @property
    def url(self) -> str:
        """URL of the panel."""
        host = f"[{self.place.host}]" if ":" in self.place.host else self.place.host
        return f"{self.place.scheme}://{host}:{self.server_address[1]}"

    def turn(self) -> None:
        """Accept a connection or wait a moment; cut off connections past their deadline, except during a press."""
        self.handle_request()
        now = time.monotonic()
        with self._lock:
            over = [
                connection
                for connection in self._connections
                if now > connection.until and not connection.presses
            ]
        for connection in over:
            connection.cut()
        if self._tls is not None and now - self._looked_at_files > _RENEWED_S:
            self._looked_at_files = now
            self._load_renewed(self._tls)

    def _load_renewed(self, tls: ssl.SSLContext) -> None:
        """Load a certificate that was renewed on disk, without a restart."""
        if (written := self.place.written) == self._written:
            return
        self._written = written
        try:
            self.place.load(tls)
        except ConfigurationError as fault:
            log.error("the certificate of before is kept: %s", fault)

    # --- connections -------------------------------------------------------------------------------------------

    def server_bind(self) -> None:
        """Bind like a plain TCP server, because HTTPServer would ask a name server for our own name."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = self.place.host, int(self.server_address[1])

    def get_request(self) -> tuple[Any, Any]:
        """Accept the next connection; the TLS handshake is left to its thread."""
        accepted, address = self.socket.accept()
        accepted.settimeout(REQUEST_S)
        # without it the parts of an answer are delayed by 40 ms (Nagle and delayed ACK)
        accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
        if self._tls is not None:
            return self._tls.wrap_socket(accepted, server_side=True, do_handshake_on_connect=False), address
        return accepted, address

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for the connection; if there are too many, cut off another."""
        source = str(client_address[0]).removeprefix("::ffff:")
        connection = Connection(request, source, time.monotonic() + REQUEST_S)
        with self._lock:
            full = self._serving >= MOST_THREADS
            if not full:
                self._serving += 1
                surplus = self._surplus(source)
                self._connections.append(connection)
        if full:  # all threads are in use and none has ended yet
            self.shutdown_request(request)
            return
        if surplus is not None:
            surplus.cut()
        try:
            threading.Thread(target=self._serve, args=(connection, client_address), daemon=True).start()
        except RuntimeError:  # the machine cannot start another thread
            self._ended(connection)

    def _surplus(self, source: str) -> Connection | None:
        """Return the oldest connection that must be cut off to admit a new one from `source`; None if there is room.

        Connections that press the e-stop are never cut off.
        """
        going = [connection for connection in self._connections if not connection.gone]
        of_it = [connection for connection in going if connection.source == source]
        among = of_it if len(of_it) >= MOST_OF_ONE else going
        if len(among) < (MOST_OF_ONE if among is of_it else MOST):
            return None
        return next((connection for connection in among if not connection.presses), None)

    def _serve(self, connection: Connection, client_address: Any) -> None:
        handshake: Callable[[], None] | None = getattr(connection.socket, "do_handshake", None)
        try:
            if handshake is not None:
                handshake()
            self.RequestHandlerClass(connection, client_address, self)  # type: ignore[arg-type]
        except OSError as error:
            log.debug("%s went away: %s", connection.source, error)
        except Exception:
            if not connection.gone:  # errors are expected after a cut: its files were closed under its thread
                log.exception("a request to the panel failed")
        finally:
            self._ended(connection)

    def _ended(self, connection: Connection) -> None:
        with self._lock:
            self._connections.remove(connection)
            self._serving -= 1
        self.shutdown_request(connection.socket)
