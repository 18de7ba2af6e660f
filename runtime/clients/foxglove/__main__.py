"""`python -m runtime.clients.foxglove STATION`: a station live in Foxglove, read-only.

Joints, commands, cameras, state, events and e-stop, in the messages of exported episodes. Foxglove connects to the
printed address, whose token only this account can read. It cannot command, and reads the station's streams only while
somebody has subscribed.
"""

from __future__ import annotations

import argparse
import logging
import os
import secrets
import signal
import ssl
import sys
import threading
import time
from collections.abc import Callable, Sequence
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import zmq

from robots.broken_pipe import exit_on_broken_pipe
from runtime.clients.foxglove.server import FoxgloveServer
from runtime.clients.foxglove.topics import StationTopics
from runtime.clients.panel.watch import StreamReader
from runtime.core import logs
from runtime.core.durable_files import write_durably
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.ipc.bus import Endpoints
from runtime.ipc.lifeline import Lifeline

log = logging.getLogger(__name__)
_TURN_S, _FIND_S = 0.02, 0.5
_NICENESS = 10  # whoever only looks comes after everything that moves
_TOKEN_FILE = "foxglove.token"
_COORDINATOR = ("state", "joints", "event")


class Bridge:
    """Reader of a station's streams, for a server; `turn` reads what has arrived and sends it on."""

    def __init__(self, context: zmq.Context[Any], station_dir: Path, server: FoxgloveServer) -> None:
        self._endpoints, self._server = Endpoints(station_dir), server
        self._readers = {stream: StreamReader(context, stream) for stream in (*_COORDINATOR, "camera/")}
        self._topics: StationTopics | None = None
        self._facts: Any = None
        self._found_at = -float("inf")

    def turn(self, seconds: float) -> None:
        """Read the streams for at most `seconds`; only those of which a topic is subscribed, and the state."""
        if time.monotonic() - self._found_at >= _FIND_S:
            self._found_at = time.monotonic()
            self._connect()
        for stream, reader in self._readers.items():
            found = (
                reader.receive_all()
                if stream == "event"
                else reader.receive(seconds if stream == "state" else 0.0).items()
            )
            for name, content in found:
                self._pass_on(name, content)

    def _connect(self) -> None:
        wanted = self._server.wanted
        topics = self._topics.topics if self._topics else ()
        streams = {topic.stream.partition("/")[0] for topic in topics if topic.name in wanted} | {"state"}
        for stream, reader in self._readers.items():
            process, socket = ("media", "cameras") if stream == "camera/" else ("coordinator", "state")
            needed = stream.removesuffix("/") in streams
            reader.turn_to(self._endpoints.address(process, socket) if needed else "")

    def _pass_on(self, name: str, content: Any) -> None:
        if name == "state" and content.get("facts") != self._facts:
            self._facts = content["facts"]
            self._topics = StationTopics(self._facts)
            self._server.advertise(self._topics.topics)
        if self._topics is None:
            return
        stamp = time.time_ns()
        for topic, payload in self._topics.messages(name, content, stamp):
            self._server.publish(topic, payload, stamp)

    def close(self) -> None:
        """Release the sockets."""
        for reader in self._readers.values():
            reader.turn_to("")


def token_of(station_dir: Path) -> str:
    """Return the token of the station's bridge, which is made once, in a file that only this account can read."""
    file = station_dir / _TOKEN_FILE
    if not file.exists():
        station_dir.mkdir(parents=True, exist_ok=True)
        write_durably(file, f"{secrets.token_urlsafe(24)}\n".encode(), mode=0o600)
    return file.read_text("ascii").strip()


def serve(
    station_dir: Path,
    options: argparse.Namespace,
    ended: Callable[[], bool],
    ready: Callable[[str], None] = print,
) -> None:
    """Serve until `ended`; `ready` is called with the address.

    Raises:
        ConfigurationError: The host needs a certificate, or cannot be listened at.
    """
    context: zmq.Context[Any] = zmq.Context.instance()
    token = token_of(station_dir)
    server = FoxgloveServer(station_dir.name, token, options.origin)
    secure = _ssl_context(options)
    try:
        port = server.open(options.host, options.port, secure)
    except OSError as error:
        raise ConfigurationError(f"--host {options.host} --port {options.port}: {error.strerror}") from None
    bridge = Bridge(context, station_dir, server)
    ready(f"{'wss' if secure else 'ws'}://{options.host}:{port}/?token={token}")
    try:
        while not ended():
            bridge.turn(_TURN_S)
    finally:
        bridge.close()
        server.close()


def _ssl_context(options: argparse.Namespace) -> ssl.SSLContext | None:
    """Return the context of the certificate, None on loopback without one.

    Raises:
        ConfigurationError: Without a certificate beyond this machine, or one that cannot be used.
    """
    try:
        loopback = ip_address(options.host).is_loopback
    except ValueError:
        raise ConfigurationError(
            f"--host {options.host!r:.100}: must be an address in numbers, as 127.0.0.1"
        ) from None
    if options.certificate is None:
        if not loopback:
            raise ConfigurationError(
                f"--host {options.host}: beyond this machine it needs --certificate and --key; allowed without: "
                "127.0.0.1"
            )
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(options.certificate, options.key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigurationError(f"--certificate {options.certificate}: {error}") from None
    return context


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal or the end of the lifeline; return 2 if it cannot."""
    parser = argparse.ArgumentParser(prog="python -m runtime.clients.foxglove", description=__doc__)
    parser.add_argument("station", help="name of a station of this computer")
    parser.add_argument("--data-dir", type=Path, metavar="DIR", help="$EVA_DATA_DIR or ./data if not given")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen at; beyond this machine it needs a certificate"
    )
    parser.add_argument("--port", type=int, default=8765, help="0 takes a free one")
    parser.add_argument("--certificate", type=Path, help="certificate with its chain, as PEM")
    parser.add_argument("--key", type=Path, help="its private key, as PEM")
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        help="address of a web page that may connect, as a browser sends it",
    )
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")
    options = parser.parse_args(arguments)
    data = Path(options.data_dir or os.environ.get("EVA_DATA_DIR") or "data").expanduser().absolute()
    logs.configure_logging("foxglove")
    os.nice(_NICENESS)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    lifeline = Lifeline() if options.lifeline else None

    def announce(address: str) -> None:
        print(address, flush=True)

    try:
        serve(
            data / "stations" / options.station,
            options,
            lambda: stop.is_set() or (lifeline is not None and lifeline.is_cut),
            announce,
        )
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
