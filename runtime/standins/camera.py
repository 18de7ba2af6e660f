"""Stand-in cameras: `python -m runtime.standins.camera rtsp` or `mjpeg`, on loopback."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence

from robots.broken_pipe import exit_on_broken_pipe
from runtime.simulation import program
from runtime.standins.camera_server import FAULTS, CameraServer
from runtime.standins.mjpeg_server import MjpegServer
from runtime.standins.rtsp_server import RtspServer

KINDS: dict[str, type[CameraServer]] = {"mjpeg": MjpegServer, "rtsp": RtspServer}


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.standins.camera",
        description="A stand-in camera.",
        epilog="faults: " + "; ".join(f"{name}: {text}" for name, text in FAULTS.items()),
    )
    line.add_argument("kind", choices=sorted(KINDS))
    line.add_argument("--port", type=int, default=0, help="0 takes a free one")
    line.add_argument("--width", type=int, default=640)
    line.add_argument("--height", type=int, default=480)
    line.add_argument("--rate", type=float, default=30.0, help="pictures per second")
    line.add_argument("--fault", choices=sorted(FAULTS), default="")
    program.add_arguments(line)
    return line


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Serve a camera until SIGTERM, SIGINT or the end of the lifeline; return 0, or 2 if the port is in use."""
    options = parser().parse_args(arguments)
    stop = program.stop_event(options.lifeline)
    server = KINDS[options.kind](options.width, options.height, options.rate, options.port)
    server.fault = options.fault
    with contextlib.closing(server):
        try:
            url = server.start()
        except OSError as error:
            print(f"--port {options.port} cannot be taken: {error.strerror}", file=sys.stderr)
            return 2
        program.announce_ready({"kind": options.kind, "url": url}, options.ready_file)
        stop.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main())
