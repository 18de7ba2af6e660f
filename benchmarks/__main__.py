"""`python -m benchmarks NAME [--json FILE]`: measure, print a table, write JSON."""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
from pathlib import Path

import benchmarks

_NOT_BENCHMARKS = (
    "__main__",
    "conveyor_station",
    "reference",
    "report",
    "sleeper",
    "step_loop",
    "strategy_station",
    "viewers",
)


def main() -> int:
    """Exit code 0 where every wanted figure holds, 1 where one does not."""
    names = sorted(m.name for m in pkgutil.iter_modules(benchmarks.__path__) if m.name not in _NOT_BENCHMARKS)
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=names)
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--seconds", type=float, default=20.0, help="of measurement per case")
    given = parser.parse_args()
    report = importlib.import_module(f"benchmarks.{given.name}").measure(given.seconds)
    print(report.table())
    if given.json:
        report.write(given.json)
    return 0 if all(figure.holds is not False for figure in report.figures) else 1


if __name__ == "__main__":
    sys.exit(main())
