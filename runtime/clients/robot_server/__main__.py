"""`python -m runtime.clients.robot_server STATION`: a station as a robot of other programs.

LeRobot's commands, inspect-robots and programs of one's own get observations and send rows, under the station's lease,
limits, e-stop and recording. The printed address has a token, which only this account can read.
"""

from __future__ import annotations

import argparse
import os
import secrets
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import zmq

from robots.broken_pipe import exit_on_broken_pipe
from runtime.clients.client import StationClient
from runtime.clients.listener import add_listener_arguments, get_or_create_token, make_ssl_context
from runtime.clients.panel.watch import StreamReader
from runtime.clients.robot_server.exchange import RowExchange
from runtime.clients.robot_server.server import RobotServer
from runtime.clients.robot_server.session import DriveSession
from runtime.core import logs
from runtime.core.errors import ConfigurationError, RuntimeFault, TransportError
from runtime.ipc.bus import Endpoints
from runtime.ipc.identity import PROGRAMS
from runtime.ipc.lifeline import Lifeline

TOKEN_FILE = "robot_server.token"
_TURN_S = 0.2
_JOINTS_S = 2.0  # for the first joints of a station


class JointsWatch:
    """Newest joints that a station publishes; its stream is read only while somebody watches."""

    def __init__(self, context: zmq.Context[Any], station_dir: Path) -> None:
        self._endpoints = Endpoints(station_dir)
        self._reader = StreamReader(context, "joints")
        self._lock = threading.Lock()

    def read(self) -> Mapping[str, Any]:
        """Return the newest joints: `measured`, `commanded`, `planned`, float32 [D]. Raises: TransportError."""
        with self._lock:
            self._reader.turn_to(self._endpoints.address("coordinator", "state"))
            newest = self._reader.receive(_JOINTS_S).get("joints")
        if newest is None:
            raise TransportError(f"the station has published no joints for {_JOINTS_S:g} s")
        return {name: newest[name] for name in ("measured", "commanded", "planned")}

    def close(self) -> None:
        """Release the socket."""
        with self._lock:
            self._reader.turn_to("")


def serve(
    station_dir: Path,
    options: argparse.Namespace,
    has_ended: Callable[[], bool],
    announce: Callable[[str], None],
) -> None:
    """Serve until `has_ended`; `announce` is called with the address.

    Raises:
        ConfigurationError: The host needs a certificate, or cannot be listened at.
    """
    context: zmq.Context[Any] = zmq.Context.instance()
    token, secure = get_or_create_token(station_dir, TOKEN_FILE), make_ssl_context(options)
    joints = JointsWatch(context, station_dir)

    def make_session(program: str) -> DriveSession:
        client, number = (
            StationClient(station_dir),
            secrets.token_hex(2),
        )  # of this connection, also to another server
        client.holder = f"{PROGRAMS}{program}#{number} {client.holder.removeprefix('terminal:')}"
        return DriveSession(client, RowExchange(context, station_dir, f"rows{number}"), program)

    server = RobotServer(token, make_session, joints.read, options.silence_s)
    try:
        port = server.open(options.host, options.port, secure)
    except OSError as error:
        raise ConfigurationError(f"--host {options.host} --port {options.port}: {error.strerror}") from None
    announce(f"{'wss' if secure else 'ws'}://{options.host}:{port}/?token={token}")
    ended = threading.Event()
    try:
        while not has_ended():
            ended.wait(_TURN_S)
    finally:
        server.close()
        joints.close()


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal or the end of the lifeline; return 2 if it cannot."""
    parser = argparse.ArgumentParser(prog="python -m runtime.clients.robot_server", description=__doc__)
    add_listener_arguments(parser, port=8766)
    parser.add_argument(
        "--silence-s",
        type=float,
        default=600.0,
        help="longest time between two requests of a program that drives; beyond it its run ends",
    )
    options = parser.parse_args(arguments)
    data = Path(options.data_dir or os.environ.get("EVA_DATA_DIR") or "data").expanduser().absolute()
    logs.configure_logging("robot_server")
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    lifeline = Lifeline() if options.lifeline else None
    try:
        serve(
            data / "stations" / options.station,
            options,
            lambda: stop.is_set() or (lifeline is not None and lifeline.is_cut),
            lambda address: print(address, flush=True),
        )
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
