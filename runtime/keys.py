"""`python -m runtime.keys new | enrol ADDRESS CODE | show`: the key of this computer, and the labs of its stations."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.errors import RuntimeFault
from runtime.link import codes, key_files
from runtime.link.enrolment import enrol


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return 0 on success, 1 on failure, after printing the reason."""
    options = _parser().parse_args(arguments)
    data = Path(options.data_dir or os.environ.get("EVA_DATA_DIR") or "data").expanduser().absolute()
    try:
        if options.what == "new":
            key = key_files.make_station_key(data, options.replace)
            print(f"the key of this computer is made: {codes.fingerprint(key.public)}")
        elif options.what == "enrol":
            _enrol(data, options.address, options.code)
        else:
            _show(data)
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.keys", description=__doc__)
    parser.add_argument("--data-dir", type=Path, metavar="DIR", help="$EVA_DATA_DIR or ./data if not given")
    actions = parser.add_subparsers(dest="what", required=True)
    new = actions.add_parser("new", help="make the key of this computer")
    new.add_argument("--replace", action="store_true", help="in place of the one that it has")
    asking = actions.add_parser("enrol", help="make a station of this computer one of a lab")
    asking.add_argument("address", metavar="ADDRESS", help="HOST:PORT, as the lab's administration shows it")
    asking.add_argument("code", metavar="CODE", nargs="+", help="the one-time code that it shows")
    actions.add_parser("show", help="the key of this computer, and the labs of its stations")
    return parser


def _enrol(data: Path, address: str, code_parts: Sequence[str]) -> None:
    code = codes.read(" ".join(code_parts))
    key = key_files.station_key(data)
    print(f"the lab's key   {codes.fingerprint(code.lab)}")
    print(f"this computer's {codes.fingerprint(key.public)}")
    lab = enrol(data, address, code, key)
    print(f"{lab.station} is a station of {lab.lab} now: start it, or python -m runtime.link {lab.station}")


def _show(data: Path) -> None:
    print(f"this computer's key {codes.fingerprint(key_files.station_key(data).public)}")
    for path in sorted((data / "stations").glob("*/lab.json")):
        lab = key_files.known_lab(path.parent)
        ports = f"ports {lab.port} and {lab.second_port}"
        print(
            f"{lab.station}: {lab.lab} at {lab.host}, {ports}, its key {codes.fingerprint(bytes.fromhex(lab.key))}"
        )


if __name__ == "__main__":
    sys.exit(main())
