"""`python -m runtime.clients.foxglove STATION`: a station live in Foxglove, read-only.

Joints, commands, cameras, state, events and e-stop, in the messages of exported episodes. Foxglove connects to the
printed address, whose token only this account can read. It cannot command, and reads the station's streams only while
somebody has subscribed.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zmq

from robots.broken_pipe import exit_on_broken_pipe
from runtime.clients.foxglove.server import FoxgloveServer
from runtime.clients.foxglove.topics import StationTopics
from runtime.clients.listener import add_listener_arguments, get_or_create_token, make_ssl_context
from runtime.clients.panel.watch import StreamReader
from runtime.core import logs
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.ipc.bus import Endpoints
from runtime.ipc.lifeline import Lifeline

log = logging.getLogger(__name__)
_TURN_S, _FIND_S = 0.02, 0.5
_NICENESS = 10  # whoever only looks comes after everything that moves
TOKEN_FILE = "foxglove.token"
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
    token = get_or_create_token(station_dir, TOKEN_FILE)
    server = FoxgloveServer(station_dir.name, token, options.origin)
    secure = make_ssl_context(options)
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


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal or the end of the lifeline; return 2 if it cannot."""
    parser = argparse.ArgumentParser(prog="python -m runtime.clients.foxglove", description=__doc__)
    add_listener_arguments(parser, port=8765)
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        help="address of a web page that may connect, as a browser sends it",
    )
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
