"""`python -m runtime.link STATION`: links a station of this computer to the lab in which it is enrolled.

An enrolled station starts this program by itself; for a lockstep station it is started by hand.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core import logs
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.ipc.bus import Endpoints
from runtime.ipc.lifeline import Lifeline
from runtime.link.key_files import key_path, known_lab, known_lab_path, station_key
from runtime.link.station import StationLink
from runtime.link.uplink import Telling
from runtime.link.uploads import UploadSettings

log = logging.getLogger(__name__)
_LOOK_S = 0.2


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the link until a signal or the end of standard input.

    Returns:
        Exit code: 1 if a thread of the link failed, 2 if there are no usable keys.
    """
    options = _parser().parse_args(arguments)
    logs.configure_logging("link")
    data = Path(options.data_dir or os.environ.get("EVA_DATA_DIR") or "data").expanduser().absolute()
    station_dir = data / "stations" / options.station
    ended: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: ended.append(number))
    lifeline = Lifeline() if options.lifeline else None
    try:
        return _linked(data, station_dir, lambda: bool(ended) or (lifeline is not None and lifeline.is_cut))
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 2


def _linked(data: Path, station_dir: Path, ended: Callable[[], bool]) -> int:
    """Run the link until `ended`; restart it after a new enrolment. Return the exit code, 1 if a thread failed.

    Raises: RuntimeFault without usable keys.
    """
    while not ended():
        written = _written(data, station_dir)
        lab, key = known_lab(station_dir), station_key(data)
        link = StationLink(station_dir, lab, key, _uploads())
        link.start()
        log.info(
            "%s links itself to %s at %s, ports %d, %d",
            lab.station,
            lab.lab,
            lab.host,
            lab.port,
            lab.second_port,
        )
        teller = Telling(Endpoints(station_dir), lab.lab)
        while not ended() and not link.failed.wait(_LOOK_S) and _written(data, station_dir) == written:
            teller.update(link.problem)
        link.end()
        teller.end()
        if link.failed.is_set():
            return 1
    return 0


def _uploads() -> UploadSettings | None:
    """Return the upload settings.

    If they are invalid, log that and return None: the link then works, but sends no episodes.
    """
    try:
        return UploadSettings.read(os.environ)
    except ConfigurationError as error:
        log.error("no episode is sent to the lab: %s", error)
        return None


def _written(data: Path, station_dir: Path) -> list[tuple[int, int]]:
    """Return inode and modification time of the key files, which change when the files are replaced."""
    statuses = [path.stat() for path in (known_lab_path(station_dir), key_path(data)) if path.exists()]
    return [(status.st_ino, status.st_mtime_ns) for status in statuses]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.link", description=__doc__)
    parser.add_argument("station", help="name of a station of this computer that is enrolled")
    parser.add_argument("--data-dir", type=Path, metavar="DIR", help="$EVA_DATA_DIR or ./data if not given")
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")
    return parser


if __name__ == "__main__":
    sys.exit(main())
