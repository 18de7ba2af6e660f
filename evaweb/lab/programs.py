"""Programs of a lab, as specifications of their processes."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from django.conf import settings

from evaweb.lab.processes import ProgramSpec

_MANAGE = str(settings.BASE_DIR / "manage.py")


def web(host: str, port: int) -> ProgramSpec:
    """Return the program of the web process: pages, REST and websockets."""

    def arguments(where: object) -> tuple[str, ...]:
        return (_MANAGE, "serve", "--host", host, "--port", str(where))

    return ProgramSpec(
        "web",
        arguments(port),
        announces=True,
        again=lambda found: arguments(port_of(found)),
        patience_s=10.0,  # requests in progress get 4 s after it is asked to end
        nice=5,
        of_web=True,
    )


def stops(descriptor: int, web_port: str) -> ProgramSpec:
    """Return the program that answers stops of the web's pages, on the inherited socket `descriptor`.

    It has priority over the web.
    """
    return ProgramSpec(
        "stops",
        (_MANAGE, "stops", "--descriptor", str(descriptor), "--web-port", web_port),
        announces=True,
        patience_s=10.0,  # like the web
        descriptors=(descriptor,),
        of_web=True,
    )


def gate(host: str, port: int) -> ProgramSpec:
    """Return the program of the gate for stations on other computers.

    It listens at `port`; images use the next port.
    """
    return ProgramSpec(
        "gate",
        (_MANAGE, "gate", "--host", host, "--port", str(port)),
        announces=True,
        patience_s=10.0,
        of_web=True,
    )


def worker() -> ProgramSpec:
    """Return the program of a worker of every queue; interrupted work is repeated at its next start."""
    return ProgramSpec("worker", (_MANAGE, "worker"), patience_s=20.0, of_web=True)


def station(deployment: str, assignments: Sequence[str]) -> ProgramSpec:
    """Return the program of a station's runtime, which supervises its own processes."""
    sets = [part for assignment in assignments for part in ("--set", assignment)]
    return ProgramSpec(f"station-{_stem(deployment)}", ("-m", "runtime", deployment, *sets), patience_s=15.0)


def bench(seed: int, width: int, height: int) -> tuple[str, ...]:
    """Return the command-line options of a simulated bench: seed of the first layout, and image size [pixels]."""
    return ("--seed", str(seed), "--width", str(width), "--height", str(height))


def tabletop(robot: str, options: Sequence[str], name: str = "bench") -> ProgramSpec:
    """Return the program of a simulated bench; it picks free ports, and uses the same ports after a restart."""

    def arguments(observations: str, commands: str) -> tuple[str, ...]:
        ends = ("--obs-endpoint", observations, "--action-endpoint", commands)
        return ("-m", "runtime.simulation.node", "--robot", robot, "--bench", "contact", *options, *ends)

    free = "tcp://127.0.0.1:0"
    return ProgramSpec(
        name,
        arguments(free, free),
        announces=True,
        again=lambda found: arguments(found["obs_endpoint"], found["action_endpoint"]),
    )


def leader(robot: str, observations: str, seed: int) -> ProgramSpec:
    """Return the program of a simulated leader, which demonstrates the bench's task.

    It picks a free port, and uses the same port after a restart.
    """

    def arguments(endpoint: str) -> tuple[str, ...]:
        watching = ("-m", "runtime.simulation.leader", "--robot", robot, "--obs-endpoint", observations)
        return (*watching, "--seed", str(seed), "--endpoint", endpoint)

    return ProgramSpec(
        "leader",
        arguments("tcp://127.0.0.1:0"),
        announces=True,
        again=lambda found: arguments(found["endpoint"]),
    )


def serving(name: str, robot: str, options: Sequence[str]) -> tuple[str, ...]:
    """Return the arguments of runtime.standins.serve, without port, for a scripted policy that uses the images."""
    return ("openpi", "--robot", robot, "--behaviour", "pick_place", "--name", name, *options)


def policy(name: str, robot: str, options: Sequence[str], port: int = 0) -> ProgramSpec:
    """Return the program that serves a scripted policy on `port`.

    If `port` is 0, the program picks a free port when it is first started. After a restart it uses the same port again.
    """

    def arguments(port: object) -> tuple[str, ...]:
        return ("-m", "runtime.standins.serve", *serving(name, robot, options), "--port", str(port))

    return ProgramSpec(
        f"policy-{name}", arguments(port), announces=True, again=lambda found: arguments(port_of(found))
    )


def at_bench(name: str, bench: str, file: str, options: Sequence[str], port: int = 0) -> ProgramSpec:
    """Return the program of a Python file of a bench, in the bench's own environment; it serves on `port`, or on a free
    one if that is 0, which it keeps after a restart.
    """

    def arguments(port: object) -> tuple[str, ...]:
        return ("-m", "runtime.benches.environments", bench, file, *options, "--port", str(port))

    return ProgramSpec(name, arguments(port), announces=True, again=lambda found: arguments(port_of(found)))


def lockstep(
    deployment: str,
    assignments: Sequence[str],
    robot: str,
    policies: Mapping[str, tuple[Sequence[str], int]],
    options: Sequence[str],
) -> ProgramSpec:
    """Return the program of a station, its simulated bench and its policy servers in one process on a virtual clock.

    `policies` maps the name of each policy server to its options and port (0: free); the program announces the servers'
    addresses. `options` are those of the bench, and may include --paced.
    """
    sets = [part for assignment in assignments for part in ("--set", assignment)]
    served = [
        part
        for name, (skill, port) in policies.items()
        for part in ("--serve", shlex.join((*serving(name, robot, skill), "--port", str(port))))
    ]
    arguments = ("-m", "runtime.standins.lockstep", deployment, *sets, *served, *options)
    return ProgramSpec(f"station-{_stem(deployment)}", arguments, announces=True, patience_s=15.0)


def port_of(found: Mapping[str, Any]) -> str:
    """Return the port of the URL that a program announced."""
    return str(found["url"]).rstrip("/").rpartition(":")[2]


def _stem(path: str) -> str:
    return path.rpartition("/")[2].removesuffix(".toml")
