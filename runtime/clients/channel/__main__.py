"""`python -m runtime.clients.channel STATION`: control channel of a running station, configured by its deployment.

The station starts it by itself if `control_channel.enabled` is set.
"""

from __future__ import annotations

import argparse
import getpass
import json
import logging
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import zmq

from robots.broken_pipe import exit_on_broken_pipe
from runtime.clients.channel.holder_names import HolderNames
from runtime.clients.channel.server import ChannelServer
from runtime.clients.client import StationClient
from runtime.config import loader as deployment
from runtime.config.schema import ControlChannelSettings
from runtime.core import logs as log
from runtime.core.errors import ConfigurationError, RuntimeFault, TransportError
from runtime.ipc.bus import Endpoints
from runtime.ipc.lifeline import Lifeline
from runtime.station.rerun import data_folder

_log = logging.getLogger(__name__)
_POLL_S = 0.1
_AGAIN_S = 1.0


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal or the supervisor's end; return the exit code, 2 if the station is unknown."""
    options = _parser().parse_args(arguments)
    log.configure_logging("channel")
    station_dir = data_folder(options.data_dir) / "stations" / options.station
    try:
        settings = _settings(station_dir)
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 2
    ended: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: ended.append(number))
    lifeline = Lifeline() if options.lifeline else None
    serve(station_dir, settings, lambda: bool(ended) or (lifeline is not None and lifeline.is_cut))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.clients.channel", description=__doc__)
    parser.add_argument("station", help="name of a station that runs on this machine")
    parser.add_argument("--data-dir", type=Path, metavar="DIR", help="$EVA_DATA_DIR or ./data if not given")
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")
    return parser


def _settings(station_dir: Path) -> ControlChannelSettings:
    path = station_dir / "resolved.json"
    try:
        tree = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"station {station_dir.name!r} is not known here ({path}: {error.__class__.__name__}); start it "
            "with python -m runtime DEPLOYMENT, or name another data folder"
        ) from None
    return deployment.resolve_deployment(tree, {}, str(path)).deployment.control_channel


def serve(station_dir: Path, settings: ControlChannelSettings, ended: Callable[[], bool]) -> None:
    """Serve until `ended` returns True; if the port is in use, try again every second."""
    operator = settings.operator or f"{getpass.getuser()}@{socket.gethostname()}"
    names = HolderNames(operator, settings.scripts)
    door = _open(station_dir, settings, names, ended)
    if door is None:
        return
    Endpoints(station_dir).write("channel", {"control": door.endpoint})
    _log.info("scripts may command over %s as channel:%s", door.endpoint, operator)
    while not ended():
        door.serve(_POLL_S)
    door.close()


def _open(
    station_dir: Path, settings: ControlChannelSettings, names: HolderNames, ended: Callable[[], bool]
) -> ChannelServer | None:
    logged = ""
    while not ended():
        try:
            return ChannelServer(
                zmq.Context.instance(),
                settings.port,
                names,
                settings.silence_s,
                lambda holder: StationClient(station_dir, holder),
            )
        except TransportError as fault:
            if str(fault) != logged:
                _log.error("%s; tried again every second", fault)
            logged = str(fault)
            time.sleep(_AGAIN_S)
    return None


if __name__ == "__main__":
    sys.exit(main())
