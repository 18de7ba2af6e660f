"""One trial at a simulated bench on a virtual clock: `python -m runtime.standins.trial DEPLOYMENT < ORDERS`.

Node, bench, policy servers and station are one process, which exits at the end of the run. ORDERS is a JSON object with
the arguments of the commands `setup` and `run`; the result is one JSON object. Because each trial has a process of its
own, it depends on nothing but its orders and options: the same rows to the bit, whatever ran before or runs beside it.
A run ends by itself as at the served station (`runtime.standins.lockstep`).
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import robots
from robots.broken_pipe import exit_on_broken_pipe
from runtime.config import loader
from runtime.core import environment
from runtime.core import logs as log
from runtime.core.clock import VirtualClock
from runtime.core.errors import RuntimeFault, SetupError
from runtime.processes.lockstep import lockstep
from runtime.simulation import environments
from runtime.simulation.node import parser as node_parser
from runtime.standins import serve
from runtime.standins.lockstep import PATIENT, bench_of, in_process_peers, success_detector
from runtime.station.checks import check_deployment

_ORDERS = ("setup", "run")
_LONGEST_S = 3600.0  # of a run without a time limit
_MARGIN_S = 10.0  # beyond the time limit


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.standins.trial",
        description="One trial at a simulated bench, in lockstep; its orders are read from standard input.",
    )
    line.add_argument("deployment", type=Path, help="one whose transport is zmq and simulated")
    line.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments")
    line.add_argument("--seed", type=int, default=0, help="grain of the pictures, and the first layout")
    line.add_argument("--bench", help="name or folder; without it, the bench of the deployment's transport")
    line.add_argument(
        "--serve",
        metavar="LINE",
        help="a policy server of this process, as a command line of runtime.standins.serve; its address replaces "
        "that of the set-up's policy",
    )
    line.add_argument("--width", type=int, default=640, help="of each picture")
    line.add_argument("--height", type=int, default=480)
    line.add_argument(
        "--lifeline",
        action="store_true",
        help="the orders are the first line of standard input, whose end kills this process",
    )
    return line


def read_orders(text: str) -> dict[str, dict[str, Any]]:
    """Return the arguments of set-up and run.

    Raises:
        SetupError: If the text is no JSON object of the two.
    """
    try:
        orders = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SetupError(f"the orders are not JSON: {error}") from None
    if not isinstance(orders, dict):
        raise SetupError(f"the orders are {orders!r:.60}; allowed: an object with {' and '.join(_ORDERS)}")
    for name, arguments in orders.items():
        if name not in _ORDERS or not isinstance(arguments, dict):
            raise SetupError(
                f"orders.{name} = {arguments!r:.60}; allowed: {' and '.join(_ORDERS)}, each an object"
            )
    return {name: dict(orders.get(name, {})) for name in _ORDERS}


def run_trial(options: argparse.Namespace, orders: Mapping[str, dict[str, Any]]) -> lockstep.LockstepRun:
    """Set up and run one trial, and return its result.

    Raises:
        RuntimeFault: If deployment or orders are invalid, or the set-up fails.
    """
    clock = VirtualClock()
    with ExitStack() as stack:
        own: list[str] = []
        if options.serve:
            server_options = serve.parser().parse_args(shlex.split(options.serve))
            server = stack.enter_context(closing(serve.build_server(server_options, clock)))
            url = str(server.start()["url"])
            orders["setup"]["policy"] = {**orders["setup"].get("policy", {}), "url": url}
            own = [f"policy.url={json.dumps(url)}"]
        spec = check_deployment(loader.load(options.deployment, [*own, *PATIENT, *options.assignments]))
        bench = options.bench or bench_of(spec)
        arguments = ("--robot", spec.robot.name, "--bench", bench, "--seed", str(options.seed))
        size = ("--width", str(options.width), "--height", str(options.height))
        node_options = node_parser().parse_args([*arguments, *size])
        around = environments.make_environment(spec.robot, node_options)
        return lockstep.run(
            spec,
            float(orders["run"].get("duration_s", _LONGEST_S)) + _MARGIN_S,
            in_process_peers(spec, clock, around, node_options),
            clock,
            success_detector(spec, around, clock),
            orders,
        )


def _die_with_input() -> None:
    """Kill this process when standard input ends: who ordered the trial is gone, and may have it run again."""
    while sys.stdin.read(1):
        pass
    os._exit(1)


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the trial that standard input describes, and print its result."""
    options = parser().parse_args(arguments)
    log.configure_logging("trial")
    try:
        orders = read_orders(sys.stdin.readline() if options.lifeline else sys.stdin.read())
        if options.lifeline:
            threading.Thread(target=_die_with_input, name="lifeline", daemon=True).start()
        done = run_trial(options, orders)
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    result = {
        "state": str(done.state),
        "reason": done.reason,
        "episode": done.episode,
        "ticks": done.ticks,
        "events": done.events,
    }
    print(json.dumps(result, default=str))
    return 0


if __name__ == "__main__":
    environment.restart_without_web_secrets()
    sys.exit(main())
