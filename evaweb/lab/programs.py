"""Programs of a lab, each as the command line that starts it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from django.conf import settings

from evaweb.lab.processes import ProgramSpec

_MANAGE = str(settings.BASE_DIR / "manage.py")


def web(host: str, port: int) -> ProgramSpec:
    """Pages, REST and websockets."""

    def arguments(where: object) -> tuple[str, ...]:
        return (_MANAGE, "serve", "--host", host, "--port", str(where))

    return ProgramSpec(
        "web",
        arguments(port),
        announces=True,
        again=lambda found: arguments(port_of(found)),
        patience_s=10.0,  # it gives requests that are under way 4 s, once it has heard
        nice=5,
        of_web=True,
    )


def stops(descriptor: int, web_port: str) -> ProgramSpec:
    """E-stop, stop and halt of the web's pages, on a socket that listens; the web gives way to it."""
    return ProgramSpec(
        "stops",
        (_MANAGE, "stops", "--descriptor", str(descriptor), "--web-port", web_port),
        announces=True,
        patience_s=10.0,  # as the web's
        descriptors=(descriptor,),
        of_web=True,
    )


def gate(host: str, port: int) -> ProgramSpec:
    """Where stations on other computers connect: at this port, with their pictures at the next."""
    return ProgramSpec(
        "gate",
        (_MANAGE, "gate", "--host", host, "--port", str(port)),
        announces=True,
        patience_s=10.0,
        of_web=True,
    )


def worker() -> ProgramSpec:
    """Worker of every queue; what it was about to do is done at the next start."""
    return ProgramSpec("worker", (_MANAGE, "worker"), patience_s=20.0, of_web=True)


def station(deployment: str, assignments: Sequence[str]) -> ProgramSpec:
    """A runtime: a family of processes with a supervisor of its own."""
    sets = [part for assignment in assignments for part in ("--set", assignment)]
    return ProgramSpec(f"station-{_stem(deployment)}", ("-m", "runtime", deployment, *sets), patience_s=15.0)


def bench(seed: int, width: int, height: int) -> tuple[str, ...]:
    """Options of a simulated bench: first layout, and pixels of its pictures."""
    return ("--seed", str(seed), "--width", str(width), "--height", str(height))


def tabletop(robot: str, options: Sequence[str], name: str = "bench") -> ProgramSpec:
    """The simulated bench with these options, on free ports that it keeps."""

    def arguments(observations: str, commands: str) -> tuple[str, ...]:
        ends = ("--obs-endpoint", observations, "--action-endpoint", commands)
        return ("-m", "runtime.sim.node", "--robot", robot, "--bench", "tabletop", *options, *ends)

    free = "tcp://127.0.0.1:0"
    return ProgramSpec(
        name,
        arguments(free, free),
        announces=True,
        again=lambda found: arguments(found["obs_endpoint"], found["action_endpoint"]),
    )


def leader(robot: str, observations: str, seed: int) -> ProgramSpec:
    """A demonstrator of the simulated bench's task with a leader arm, on a free port that it keeps."""

    def arguments(endpoint: str) -> tuple[str, ...]:
        watching = ("-m", "runtime.sim.leader", "--robot", robot, "--obs-endpoint", observations)
        return (*watching, "--seed", str(seed), "--endpoint", endpoint)

    return ProgramSpec(
        "leader",
        arguments("tcp://127.0.0.1:0"),
        announces=True,
        again=lambda found: arguments(found["endpoint"]),
    )


def _serving(name: str, robot: str, options: Sequence[str], port: object) -> tuple[str, ...]:
    """A scripted policy that looks at the pictures, as runtime.sim.serve is asked for it."""
    what = ("openpi", "--robot", robot, "--behaviour", "pick_place")
    return (*what, "--name", name, "--port", str(port), *options)


def policy(name: str, robot: str, options: Sequence[str], port: int = 0) -> ProgramSpec:
    """A scripted policy on that port, or on a free one that it keeps."""

    def arguments(port: object) -> tuple[str, ...]:
        return ("-m", "runtime.sim.serve", *_serving(name, robot, options, port))

    return ProgramSpec(
        f"policy-{name}", arguments(port), announces=True, again=lambda found: arguments(port_of(found))
    )


def lockstep(
    deployment: str,
    assignments: Sequence[str],
    robot: str,
    policies: Mapping[str, tuple[Sequence[str], int]],
    options: Sequence[str],
) -> ProgramSpec:
    """A station, its simulated bench and its policy servers in one process on a virtual clock.

    `policies`: by name, the options of each and its port, 0 for a free one; it announces their addresses. `options`:
    those of the bench, and --paced.
    """
    sets = [part for assignment in assignments for part in ("--set", assignment)]
    served = [
        part
        for name, (skill, port) in policies.items()
        for part in ("--serve", shlex.join(_serving(name, robot, skill, port)))
    ]
    arguments = ("-m", "runtime.sim.lockstep", deployment, *sets, *served, *options)
    return ProgramSpec(f"station-{_stem(deployment)}", arguments, announces=True, patience_s=15.0)


def port_of(found: Mapping[str, Any]) -> str:
    """The port in what a program announced."""
    return str(found["url"]).rstrip("/").rpartition(":")[2]


def _stem(path: str) -> str:
    return path.rpartition("/")[2].removesuffix(".toml")
