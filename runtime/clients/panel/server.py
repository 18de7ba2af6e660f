"""The panel's server: few connections, each with a deadline, and always room for one more.

Knows nothing of stations. A connection is a thread; where there are too many, the oldest that presses nothing is cut
off for the newest, so that slow or greedy clients keep nobody from the e-stop.
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
REQUEST_S = 10.0  # for one request from its first byte to the end of the answer; and between two
MOST, MOST_OF_ONE, MOST_THREADS = 32, 12, 64
_LOOK_S = 0.25
_RENEWED_S = 30.0  # between two looks at the certificate's files


@dataclass(eq=False, slots=True)
class Connection:
    """One connection: of which address, until when [s], and whether it presses the e-stop just now."""

    socket: socket.socket
    source: str
    until: float
    presses: bool = False
    gone: bool = False  # it was cut off, and its thread has not noticed yet

    def cut(self) -> None:
        """End what it waits for; its thread closes it. Not SSLSocket's own shutdown, which its thread may be in."""
        self.gone = True
        with suppress(OSError):
            socket.socket.shutdown(self.socket, socket.SHUT_RDWR)


class PanelServer(ThreadingHTTPServer):
    """Serves `handler` at the panel's place; `turn` again and again. TransportError where it cannot listen."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 1024  # a flood that waits to be taken in keeps nobody waiting for a second
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
        """Where it listens."""
        host = f"[{self.place.host}]" if ":" in self.place.host else self.place.host
        return f"{self.place.scheme}://{host}:{self.server_address[1]}"

    def turn(self) -> None:
        """Take a connection, or wait a moment for one; cut off those whose time is over."""
        self.handle_request()
        now = time.monotonic()
        with self._lock:
            over = [one for one in self._connections if now > one.until and not one.presses]
        for one in over:
            one.cut()
        if self._tls is not None and now - self._looked_at_files > _RENEWED_S:
            self._looked_at_files = now
            self._load_renewed(self._tls)

    def _load_renewed(self, tls: ssl.SSLContext) -> None:
        """A certificate that was renewed on the disk is taken as it is, without a restart."""
        if (written := self.place.written) == self._written:
            return
        self._written = written
        try:
            self.place.load(tls)
        except ConfigurationError as fault:
            log.error("the certificate of before is kept: %s", fault)

    # --- connections -------------------------------------------------------------------------------------------

    def server_bind(self) -> None:
        """As a plain TCP server: its base asks a name server for our own name."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = self.place.host, int(self.server_address[1])

    def get_request(self) -> tuple[Any, Any]:
        """The next connection; its handshake is its own thread's."""
        found, address = self.socket.accept()
        found.settimeout(REQUEST_S)
        # else answers wait 40 ms for each other
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
        if self._tls is not None:
            return self._tls.wrap_socket(found, server_side=True, do_handshake_on_connect=False), address
        return found, address

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give it a thread, and where there are too many take that of another."""
        source = str(client_address[0]).removeprefix("::ffff:")
        made = Connection(request, source, time.monotonic() + REQUEST_S)
        with self._lock:
            full = self._serving >= MOST_THREADS
            if not full:
                self._serving += 1
                surplus = self._surplus(source)
                self._connections.append(made)
        if full:  # all of them are busy with what cannot be cut off
            self.shutdown_request(request)
            return
        if surplus is not None:
            surplus.cut()
        try:
            threading.Thread(target=self._serve, args=(made, client_address), daemon=True).start()
        except RuntimeError:  # the machine gives no more
            self._ended(made)

    def _surplus(self, source: str) -> Connection | None:
        """The oldest connection that has to make room for one more of that source."""
        going = [one for one in self._connections if not one.gone]
        of_it = [one for one in going if one.source == source]
        among = of_it if len(of_it) >= MOST_OF_ONE else going
        if len(among) < (MOST_OF_ONE if among is of_it else MOST):
            return None
        return next((one for one in among if not one.presses), None)

    def _serve(self, connection: Connection, client_address: Any) -> None:
        handshake: Callable[[], None] | None = getattr(connection.socket, "do_handshake", None)
        try:
            if handshake is not None:
                handshake()
            self.RequestHandlerClass(connection, client_address, self)  # type: ignore[arg-type]
        except OSError as error:
            log.debug("%s went away: %s", connection.source, error)
        except Exception:
            if not connection.gone:  # a file of a connection that was cut off is closed under its thread
                log.exception("a request to the panel failed")
        finally:
            self._ended(connection)

    def _ended(self, connection: Connection) -> None:
        with self._lock:
            self._connections.remove(connection)
            self._serving -= 1
        self.shutdown_request(connection.socket)
