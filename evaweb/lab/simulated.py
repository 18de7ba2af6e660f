"""Simulated bench with policies of different skill, for the demo and for the first steps."""

from __future__ import annotations

import json
import re
import shlex
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from evaweb.core.errors import EvaError
from evaweb.lab import demo_rows, lifetime, programs
from evaweb.lab.processes import ChildProcesses, LabError, ProgramSpec
from evaweb.plans import copies
from evaweb.trials.models import Checkpoint

SKILLED, CLUMSY = "pick-place-40k", "pick-place-8k"


@dataclass(frozen=True)
class ScriptedPolicy:
    """Scripted policy of a simulated bench: its latency, and the options of its server that determine its skill."""

    description: str
    latency_ms: int
    skill: tuple[str, ...]


POLICIES = {
    SKILLED: ScriptedPolicy(
        "Scripted; sees the block within a millimetre or two, answers in 80 ms.", 80, ("--noise", "1")
    ),
    CLUMSY: ScriptedPolicy(
        "Scripted; misjudges the block by centimetres, often lets go early or grasps short, answers in 250 ms.",
        250,
        ("--noise", "14", "--failure-rate", "0.4"),
    ),
}


@dataclass(frozen=True)
class Benches:
    """Settings of this lab's simulated benches.

    Attributes:
        seed: Seed of the first layout.
        pictures: Width and height of the camera images [pixels].
        assignments: Assignments KEY=VALUE that override settings in the deployments of the benches' stations.
    """

    seed: int = 1
    pictures: tuple[int, int] = (640, 480)
    assignments: Sequence[str] = ()

    @property
    def options(self) -> tuple[str, ...]:
        """Command-line options of a bench."""
        return programs.bench(self.seed, *self.pictures)

    def skill(self, policy: str) -> tuple[str, ...]:
        """Return the command-line options of a policy's server that determine its skill."""
        return (*POLICIES[policy].skill, "--seed", str(self.seed))

    def write_copies(
        self, station: str, robot: str, deployment: Path, urls: Mapping[str, str], assignments: Sequence[str]
    ) -> None:
        """Record how copies of a station are started for trials without people.

        Args:
            station: Name of the station.
            robot: Name of its robot.
            deployment: Deployment file of the station.
            urls: Name of each policy server -> its address; the names begin with those of POLICIES.
            assignments: Assignments that the station has beside its endpoints.
        """
        servers = {}
        for name, url in urls.items():
            policy = next(known for known in POLICIES if name.startswith(known))
            line = shlex.join(programs.serving(name, robot, self.skill(policy)))
            servers[url] = {"line": line, "delay_ms": POLICIES[policy].latency_ms}
        first = [f"policy.url={json.dumps(url)}" for url in [*urls.values()][:1]]
        copies.write_copies(
            station, copies.Copies(str(deployment), [*first, *assignments], self.options, servers)
        )

    def server(self, policy: str) -> tuple[str, ...]:
        """Return the command-line options of a policy's server in real time: its skill and its latency."""
        return (*self.skill(policy), "--latency-ms", str(POLICIES[policy].latency_ms))


def simulated_options(parser: ArgumentParser) -> None:
    """Add the options of a command that starts simulated benches."""
    parser.add_argument(
        "--pictures",
        type=_pixels,
        default=Benches.pictures,
        metavar="WxH",
        help="of the simulated cameras; 400x300, the least in which the policies see the block, spares work",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="on top of the deployment of a simulated station, as with python -m runtime",
    )


def benches_of(options: Mapping[str, Any]) -> Benches:
    """Return the settings of the simulated benches that these command-line options request.

    The options may lack --seed; the default seed is used then.
    """
    return Benches(options.get("seed", Benches.seed), options["pictures"], options["set"])


def bring(
    processes: ChildProcesses, station: str, robot: str, deployment: Path, how: Benches
) -> Generator[str, None, list[str]]:
    """Start bench and policies of a station step by step; yield the name of each as it is started.

    Returns the assignments that override the station's deployment. A policy server is shared by all stations with this
    robot. The checkpoint of the server is created, or updated with the server's address.
    """
    program = programs.tabletop(robot, how.options, f"bench-{station}")
    node = yield from _starting(processes, program, "the simulated bench")
    for policy, scripted in POLICIES.items():
        name = f"{policy}-{robot}"
        serving = programs.policy(name, robot, how.server(policy), known_port(name))
        if serving.name not in processes.pids():
            addresses = yield from _starting(processes, serving, f"the policy {name}")
            demo_rows.demo_checkpoint(
                name=name, description=scripted.description, policy={"url": addresses["url"]}
            )
    urls = {name: _url_of(name) for name in (f"{policy}-{robot}" for policy in POLICIES)}
    how.write_copies(station, robot, deployment, urls, how.assignments)
    return [
        f'transport.sub_endpoint="{node["obs_endpoint"]}"',
        f'transport.pub_endpoint="{node["action_endpoint"]}"',
        f"policy.url={json.dumps(urls[f'{SKILLED}-{robot}'])}",
        *how.assignments,
    ]


def _starting(
    processes: ChildProcesses, program: ProgramSpec, label: str
) -> Generator[str, None, Mapping[str, Any]]:
    begun = processes.starting(program)
    while True:
        try:
            next(begun)
        except StopIteration as ready:
            addresses: Mapping[str, Any] = ready.value
            return addresses
        yield label


def known_port(name: str) -> int:
    """Return the port of the checkpoint's previous policy server if it is free, else 0.

    The same port is preferred because a frozen plan contains the address.
    """
    return free_port_of(Checkpoint.objects.filter(name=name).values_list("policy__url", flat=True).first())


def _url_of(name: str) -> str:
    """Return the address of a checkpoint's policy.

    Raises:
        LabError: If it has none.
    """
    checkpoint = Checkpoint.objects.filter(name=name).first()
    if checkpoint is None:
        raise LabError(
            f"the checkpoint {name} was deleted while its policy runs: start the lab anew, and it is made again"
        )
    url = checkpoint.policy.get("url")
    if not url or not isinstance(url, str):
        raise LabError(
            f"the checkpoint {name} has no url in its policy: give it one, or start the lab anew, and it has that of "
            "its policy again"
        )
    return url


def _pixels(text: str) -> tuple[int, int]:
    """Parse the size of images, such as "640x480", and return (width, height).

    Sizes below 400x300 are refused: that is the smallest size at which the scripted policies always detect the block.

    Raises: ArgumentTypeError for any other text.
    """
    match = re.fullmatch(r"(\d{3,4})x(\d{3,4})", text)
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (400 <= width <= 4096 and 300 <= height <= 4096):
        raise ArgumentTypeError(f"{text!r}; allowed: width x height in pixels, 400x300 to 4096x4096")
    return width, height


def free_port_of(url: str | None) -> int:
    """Return the port of that URL if it has one that is free, else 0."""
    try:
        port = urlsplit(url).port if isinstance(url, str) else None
    except ValueError:  # a person may have entered anything
        return 0
    if not port:
        return 0
    try:
        lifetime.require_free("127.0.0.1", port)
    except EvaError:
        return 0
    return port
