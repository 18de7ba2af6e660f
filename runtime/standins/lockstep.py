"""Station with a simulated bench on a virtual clock: `python -m runtime.standins.lockstep DEPLOYMENT`.

Node, bench, policy servers and station are one process with one clock; pages and programs connect to the station as to
any other. With the same seeds, the same commands in the same order have the same result, to the tick, on any machine
and under any load. A run ends by itself once the bench's ground truth has reported success for a second; with --paced,
the station is at most as fast as real time, and runs do not end by themselves.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import robots
from robots.broken_pipe import exit_on_broken_pipe
from runtime.config import loader
from runtime.core import environment
from runtime.core import logs as log
from runtime.core.clock import Clock, VirtualClock
from runtime.core.errors import RuntimeFault, SetupError
from runtime.processes.coordinator.builders import make_policy
from runtime.processes.lockstep.lockstep import Peers
from runtime.processes.lockstep.server import ServedLockstep
from runtime.processes.reception.process import make_source
from runtime.simulation import environments, program
from runtime.simulation.environment import Environment
from runtime.simulation.in_process_node import InProcessNode
from runtime.simulation.leader import AttachedLeader, demonstrator
from runtime.simulation.node import Node
from runtime.simulation.node import parser as node_parser
from runtime.standins import serve
from runtime.station.checks import check_deployment
from runtime.station.spec import StationSpec

REST_S = 1.0  # duration of success after which a run ends
# Deadlines count real seconds; a server in this process must not be declared lost because the machine is busy.
PATIENT = ["policy.connect_deadline=60.0", "policy.inference_deadline=60.0"]


class SuccessDetector:
    """Detector of the end of a run: the bench's ground truth has reported success for `rest` [s], or its own end."""

    def __init__(
        self, truth: Callable[[], Mapping[str, Any] | None], clock: Clock, rest: float = REST_S
    ) -> None:
        self._truth, self._clock, self._rest = truth, clock, rest
        self._since: float | None = None

    def __call__(self, running: bool) -> str:
        truth = self._truth() if running else None
        if truth and truth.get("over"):
            return f"the simulated bench is over: {truth['over']}"
        if not (truth and truth["success"]):
            self._since = None
            return ""
        if not self._rest:
            return "the simulated bench has said success"
        self._since = self._clock.now() if self._since is None else self._since
        rested = self._clock.now() - self._since >= self._rest - 1e-6
        return f"the simulated bench has said success for {self._rest:g} s" if rested else ""


def success_detector(spec: StationSpec, around: Environment, clock: Clock) -> SuccessDetector:
    """Return the detector for a station's bench; in benchmark mode a run ends with the first success."""
    return SuccessDetector(around.truth, clock, 0.0 if spec.deployment.lockstep.benchmark else REST_S)


def in_process_peers(
    made: StationSpec, clock: Clock, around: Environment, options: argparse.Namespace
) -> Peers:
    """Return the station's peers, with a simulated node in this process as transport and with a simulated leader.

    Raises:
        SetupError: If the deployment does not declare a simulated node with a bench.
    """
    transport = made.deployment.transport
    if not made.capabilities.bench or transport.kind != "zmq":
        raise SetupError(
            f"transport.kind = {transport.kind!r} with a bench in lockstep; allowed: zmq with simulated = true"
        )
    options.as_given = made.deployment.lockstep.benchmark
    node = Node(made.robot, options, clock, around)
    if made.deployment.collection is None:  # nobody leads, and some robots have no arm that could
        link, policy = InProcessNode(node, made.robot, clock), make_policy
    else:
        leader = AttachedLeader(
            made.robot, clock, demonstrator(made.robot, made.deployment.task, options.seed)
        )
        link = InProcessNode(node, made.robot, clock, leader.update)
        policy = partial(make_policy, leader=lambda spec, clock: leader)
    return Peers(
        source=lambda spec, clock: make_source(spec, clock, lambda *of: link),
        sink=lambda spec, clock: link,
        policy=policy,
    )


def bench_of(spec: StationSpec) -> str:
    """Return the bench that a deployment's transport declares; the tabletop with contact forces, "none" without any."""
    declared = spec.capabilities.bench
    return "contact" if declared == "tabletop" else declared or "none"


def station(
    path: Path, assignments: Sequence[str], clock: VirtualClock, *bench_options: str, paced: bool = False
) -> ServedLockstep:
    """Return the station of a deployment with its bench; `bench_options` are options of a simulated node.

    If `paced`, virtual time runs at most as fast as real time, and the success of the task does not end a run, except
    in benchmark mode.

    Raises:
        RuntimeFault: If the deployment is invalid, or its bench is not possible.
    """
    spec = check_deployment(loader.load(path, assignments))
    arguments = (
        "--robot",
        spec.robot.name,
        "--bench",
        bench_of(spec),
        *bench_options,
    )  # the last --bench counts
    options = node_parser().parse_args(arguments)
    around = environments.make_environment(spec.robot, options)
    peers = in_process_peers(spec, clock, around, options)
    detector = success_detector(spec, around, clock)
    ends = not paced or spec.deployment.lockstep.benchmark
    return ServedLockstep(spec, clock, detector if ends else lambda running: "", peers=peers, paced=paced)


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.standins.lockstep", description="A station at a simulated bench, in lockstep."
    )
    line.add_argument("deployment", type=Path, help="one whose transport is zmq and simulated")
    line.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments")
    line.add_argument("--seed", type=int, default=0, help="the first layout of the bench")
    line.add_argument(
        "--bench",
        help="tabletop: block and plate that move by rules; without it, the bench of the deployment's transport, with "
        "contact forces",
    )
    line.add_argument(
        "--serve",
        action="append",
        default=[],
        metavar="LINE",
        help="a policy server of this process, as a command line of runtime.standins.serve; the first is the "
        "deployment's",
    )
    line.add_argument(
        "--paced", action="store_true", help="no faster than life, and a run ends as at a real bench"
    )
    line.add_argument("--width", type=int, default=640, help="of each picture")
    line.add_argument("--height", type=int, default=480)
    program.add_arguments(line)
    return line


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the station until SIGTERM, SIGINT or the end of the lifeline."""
    options = parser().parse_args(arguments)
    log.configure_logging("lockstep")
    stop = program.stop_event(options.lifeline)
    clock = VirtualClock()
    try:
        with ExitStack() as stack:
            urls: dict[str, str] = {}
            for line in options.serve:
                server_options = serve.parser().parse_args(shlex.split(line))
                server = stack.enter_context(closing(serve.build_server(server_options, clock)))
                urls[str(server_options.name or len(urls))] = str(server.start()["url"])
            own = [f'policy.url="{url}"' for url in [*urls.values()][:1]] + (PATIENT if urls else [])
            bench = (*(("--bench", options.bench) if options.bench else ()), "--seed", options.seed)
            size = ("--width", options.width, "--height", options.height)
            served = station(
                options.deployment,
                [*own, *options.assignments],
                clock,
                *map(str, bench + size),
                paced=options.paced,
            )
            stack.enter_context(closing(served))
            program.announce_ready({"policies": urls}, options.ready_file)
            served.serve(stop.is_set)
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    environment.restart_without_web_secrets()
    sys.exit(main())
