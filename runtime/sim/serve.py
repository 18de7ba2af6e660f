"""Stand-in policy servers: `python -m runtime.sim.serve openpi --robot NAME`; one file per protocol."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence

from runtime.errors import RuntimeFault
from runtime.sim import faults, standin


def parser() -> argparse.ArgumentParser:
    """The command line."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.sim.serve",
        description="A stand-in policy server.",
        epilog="faults: " + "; ".join(f"{name}: {text}" for name, text in faults.NAMES.items()),
    )
    line.add_argument("protocol", choices=["openpi"])
    line.add_argument("--robot", required=True, help="name of a folder in robots/, or a path")
    line.add_argument("--port", type=int, default=8000, help="0 takes a free one")
    line.add_argument("--horizon", type=int, default=50, help="rows per chunk")
    line.add_argument("--rate", type=float, help="rows per second; the robot's control rate if not given")
    line.add_argument("--latency-ms", type=float, default=0.0, help="time that an inference takes")
    line.add_argument("--seed", type=int, default=0, help="which gesture")
    line.add_argument("--fault", type=faults.parse, default=faults.NONE, metavar="NAME[:ARG]")
    standin.add_arguments(line)
    return line


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until SIGTERM, SIGINT or the end of the lifeline."""
    import robots
    from runtime.sim.openpi_server import Behaviour, OpenpiServer

    options = parser().parse_args(arguments)
    told = standin.ending(options.lifeline)
    try:
        robot = robots.load(options.robot)
        behaviour = Behaviour(
            horizon=options.horizon,
            rate=options.rate or robot.control_rate,
            latency=options.latency_ms / 1e3,
            fault=options.fault,
            seed=options.seed,
        )
        with contextlib.closing(OpenpiServer(robot, behaviour, options.port)) as server:
            standin.announce(server.start(), options.ready_file)
            told.wait()
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
