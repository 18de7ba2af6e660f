"""`python -m benchmarks NAME [--json [FILE]]`: measure, print a table, and write or print JSON."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

from robots.broken_pipe import exit_on_broken_pipe

_BENCHMARKS = (
    "chaos",
    "contact",
    "coverage",
    "designs",
    "estop",
    "farm",
    "glass",
    "ik",
    "interop",
    "lab",
    "latency",
    "live",
    "loop",
    "measures",
    "moving_target",
    "pages",
    "partial_credit",
    "peers_sim",
    "recording",
    "replay",
    "results",
    "soak",
    "start",
    "strategies",
    "wires",
)
_SETTABLE = ("latency", "loop")
_SEEDED = ("chaos",)
_LONG = ("chaos", "designs", "peers_sim", "recording", "results")
_SECONDS = 20.0


@exit_on_broken_pipe
def main() -> int:
    """Run a benchmark; return 0 if every figure that has a requirement meets it, else 1."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=_BENCHMARKS)
    parser.add_argument(
        "--json", nargs="?", const="-", metavar="FILE", help="without FILE: print it in place of the table"
    )
    parser.add_argument("--seconds", type=float, help="of measurement per case")
    parser.add_argument("--minutes", type=float, help="the same in minutes")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="assignments",
        help=f"on top of the deployment, for {' and '.join(_SETTABLE)}: control.realtime=off",
    )
    parser.add_argument(
        "--long", "--full", action="store_true", help=f"more and longer cases, for {' and '.join(_LONG)}"
    )
    parser.add_argument("--seed", type=int, help=f"of what happens, for {' and '.join(_SEEDED)}; else drawn")
    arguments = parser.parse_args()
    if arguments.assignments and arguments.name not in _SETTABLE:
        parser.error(f"--set is for {' and '.join(_SETTABLE)}")
    if arguments.long and arguments.name not in _LONG:
        parser.error(f"--long is for {' and '.join(_LONG)}")
    if arguments.seed is not None and arguments.name not in _SEEDED:
        parser.error(f"--seed is for {' and '.join(_SEEDED)}")
    if arguments.seconds and arguments.minutes:
        parser.error("--seconds and --minutes say the same: give one of them")
    module = importlib.import_module(f"benchmarks.{arguments.name}")
    seconds = arguments.seconds or 60.0 * (arguments.minutes or 0.0) or getattr(module, "SECONDS", _SECONDS)
    options = {"long": True} if arguments.long else {}
    if arguments.seed is not None:
        options["seed"] = arguments.seed
    report = module.measure(seconds, *([arguments.assignments] if arguments.assignments else []), **options)
    print(report.json() if arguments.json == "-" else report.table())
    if arguments.json not in (None, "-"):
        report.write(Path(arguments.json))
    return 0 if all(figure.holds is not False for figure in report.figures) else 1


if __name__ == "__main__":
    sys.exit(main())
