"""`python -m runtime.clients.panel STATION [--set-pin]`: panel of a station, and its PIN.

A station whose deployment has a [panel] starts it by itself; for a lockstep station it is started by hand.
"""

from __future__ import annotations

import argparse
import getpass
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import zmq

from robots.broken_pipe import exit_on_broken_pipe
from runtime.clients.panel.pin import Attempts, PinFile
from runtime.clients.panel.requests import Panel
from runtime.clients.panel.server import PanelServer
from runtime.clients.panel.sessions import Sessions
from runtime.clients.panel.settings import place_of
from runtime.clients.panel.stops import Stops
from runtime.clients.panel.watch import Watch
from runtime.core import logs
from runtime.core.errors import RuntimeFault, TransportError
from runtime.ipc.bus import Endpoints
from runtime.ipc.lifeline import Lifeline

log = logging.getLogger(__name__)
_AGAIN_S = 1.0


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until a signal or the end of standard input; with --set-pin set the PIN instead.

    Returns:
        Exit code: 2 if the deployment has no panel or the PIN cannot be set.
    """
    options = _parser().parse_args(arguments)
    data = Path(options.data_dir or os.environ.get("EVA_DATA_DIR") or "data").expanduser().absolute()
    station_dir = data / "stations" / options.station
    try:
        if options.set_pin:
            PinFile(station_dir).set(_prompt_pin())
            print(
                f"the panel of {options.station} has another PIN: who had given the former one gives it anew"
            )
            return 0
        logs.configure_logging("panel")
        ended: list[int] = []
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: ended.append(number))
        lifeline = Lifeline() if options.lifeline else None
        serve(station_dir, lambda: bool(ended) or (lifeline is not None and lifeline.is_cut))
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 2
    return 0


def serve(station_dir: Path, ended: Callable[[], bool]) -> None:
    """Serve until `ended`; if the port is in use, try again every second. Raises: ConfigurationError."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
    pin, endpoints = PinFile(station_dir), Endpoints(station_dir)
    stops, watch = Stops(context, station_dir), Watch(context, station_dir)
    panel = Panel(station_dir.name, place_of(station_dir), pin, Sessions(pin, Attempts()), stops, watch)
    try:
        server = _open(panel, ended)
        if server is None:
            return
        endpoints.write("panel", {"panel": server.url})
        log.info("the panel of %s is at %s", panel.station, server.url)
        if pin.version == (0, 0):
            log.warning(
                "the panel has no PIN: it shows its e-stop alone, until python -m runtime.clients.panel %s --set-pin",
                panel.station,
            )
        while not ended():
            server.turn()
            if endpoints.is_missing("panel"):
                endpoints.write("panel", {"panel": server.url})
        endpoints.withdraw("panel")
        server.server_close()
    finally:
        watch.end()


def _open(panel: Panel, ended: Callable[[], bool]) -> PanelServer | None:
    logged = ""
    while not ended():
        try:
            return panel.server()
        except TransportError as fault:
            if str(fault) != logged:
                log.error("%s; tried again every second", fault)
            logged = str(fault)
            time.sleep(_AGAIN_S)
    return None


def _prompt_pin() -> str:
    """Return the PIN: typed twice at a terminal, else the first line of standard input."""
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\n")
    pin = getpass.getpass("PIN: ")
    if getpass.getpass("again: ") != pin:
        raise RuntimeFault("the two differ: nothing was changed")
    return pin


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.clients.panel", description=__doc__)
    parser.add_argument("station", help="name of a station of this computer")
    parser.add_argument("--data-dir", type=Path, metavar="DIR", help="$EVA_DATA_DIR or ./data if not given")
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")
    parser.add_argument("--set-pin", action="store_true", help="ask for another PIN, keep its hash, end")
    return parser


if __name__ == "__main__":
    sys.exit(main())
