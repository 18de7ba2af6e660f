"""`manage.py demo`: a small lab with a simulated bench and two policies of different skill."""

from __future__ import annotations

import json
import os
from argparse import ArgumentParser
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from django.conf import settings
from django.core.management.base import BaseCommand, CommandError

import robots
from evaweb.errors import EvaError
from evaweb.lab import programs, seed
from evaweb.lab.lab import Bench, Lab, a_lab
from evaweb.lab.lifetime import Ended
from evaweb.lab.once import Choice, perform, report
from evaweb.lab.seed import Login
from evaweb.lab.visitor import Visitor
from evaweb.roles import Role

_DEPLOYMENTS = settings.BASE_DIR / "deployments"
_STATION, _ROBOT = "bench-1", "agilex_piper"
_SKILLED, _CLUMSY = "pick-place-40k", "pick-place-8k"
_POLICIES = {
    _SKILLED: (
        "Scripted; sees the block within a millimetre or two, answers in 80 ms.",
        ("--noise", "1", "--latency-ms", "80"),
    ),
    _CLUMSY: (
        "Scripted; misjudges the block by centimetres, often lets go early or grasps short, answers in 250 ms.",
        ("--noise", "14", "--failure-rate", "0.4", "--latency-ms", "250"),
    ),
}


class Command(BaseCommand):
    """Bring up the demo and stay until Ctrl-C, or run one trial with --once."""

    help = "A lab on this machine that needs no robot: web, worker, a simulated bench, two policy servers."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("--host", default="127.0.0.1", help="address that the web listens on")
        parser.add_argument("--port", type=int, default=8000, help="port of the web; 0 takes a free one")
        parser.add_argument("--once", action="store_true", help="run, score and publish one trial, then end")
        parser.add_argument("--json", type=Path, metavar="FILE", help="with --once: write the result there")
        parser.add_argument(
            "--ready-file", type=Path, help="write address and logins there as JSON, for scripts"
        )
        parser.add_argument("--robot", default=_ROBOT, help="which robot the simulated bench has")
        parser.add_argument("--seed", type=int, default=1, help="of the bench and of the policies")
        parser.add_argument("--position", type=int, default=1, help="with --once: the position of the scene")
        parser.add_argument(
            "--checkpoint", default=_SKILLED, choices=list(_POLICIES), help="with --once: which policy"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        deployment = _deployment(options["robot"])
        try:
            with a_lab(options["host"], options["port"]) as lab:
                url, logins = self._up(lab, deployment, options["robot"], options["seed"])
                if options["ready_file"]:
                    _announce(options["ready_file"], url, logins, lab.processes.pids())
                if options["once"]:
                    self._once(url, logins[0], options)
                else:
                    self._welcome(url, logins)
                    lab.watch()
        except Ended:
            self.stdout.write("ended; the data stays in " + str(settings.DATA_DIR))
        except EvaError as error:
            if options["json"]:
                options["json"].write_text(json.dumps({"error": str(error)}), "utf-8")
            raise CommandError(str(error)) from None

    def _up(self, lab: Lab, deployment: Path, robot: str, seed_number: int) -> tuple[str, list[Login]]:
        node = lab.processes.start(programs.tabletop(robot, seed_number))
        served = {}
        for name, (description, options) in _POLICIES.items():
            serving = programs.policy(name, robot, (*options, "--seed", str(seed_number)))
            served[name] = lab.processes.start(serving)["url"]
            seed.demo_checkpoint(name=name, description=description, policy={"url": served[name]})
        seed.demo_scene()
        assignments = [
            f'robot="{robot}"',
            f'transport.sub_endpoint="{node["obs_endpoint"]}"',
            f'transport.pub_endpoint="{node["action_endpoint"]}"',
            f'policy.url="{served[_SKILLED]}"',
        ]
        url = lab.up([Bench(deployment, assignments)])
        roles = {"operator": Role.OPERATOR, "admin": Role.ADMIN}
        return url, [seed.demo_login(username=name, role=role) for name, role in roles.items()]

    def _welcome(self, url: str, logins: list[Login]) -> None:
        self.stdout.write(f"\nEVA Web is at {url}\n")
        for login in logins:
            self.stdout.write(f"  {login.username:<10}{login.password}")
        self.stdout.write(f"\nThe data is in {settings.DATA_DIR}, logs in its folder logs.")
        self.stdout.write("Ctrl-C ends everything.")
        self.stdout.flush()

    def _once(self, url: str, operator: Login, options: dict[str, Any]) -> None:
        visitor = Visitor(url)
        visitor.login(operator.username, operator.password)
        choice = Choice(
            _STATION, "block-on-plate", options["position"], options["checkpoint"], options["seed"]
        )
        done = perform(visitor, choice)
        text = json.dumps(report(done), indent=1)
        if options["json"]:
            options["json"].write_text(text, "utf-8")
        self.stdout.write(text)


def _deployment(robot: str) -> Path:
    """The tabletop's deployment for that robot, else the one for any; CommandError lists the robots."""
    if robot not in robots.names():
        raise CommandError(f"--robot {robot}: allowed: {', '.join(robots.names())}")
    own = _DEPLOYMENTS / f"tabletop_{robot}.toml"
    return own if own.is_file() else _DEPLOYMENTS / "tabletop.toml"


def _announce(path: Path, url: str, logins: list[Login], pids: Mapping[str, int]) -> None:
    """Whole or not at all, and readable by its user alone."""
    draft = path.with_name(f"{path.name}.{os.getpid()}")
    passwords = {login.username: login.password for login in logins}
    with os.fdopen(
        os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8"
    ) as file:
        json.dump({"url": url, "passwords": passwords, "pids": dict(pids)}, file)
    draft.replace(path)
