"""`manage.py demo`: a small lab with a simulated bench and two policies of different skill."""

from __future__ import annotations

import json
import time
from argparse import ArgumentParser
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from django.conf import settings
from django.core.management.base import BaseCommand, CommandError

import robots
from evaweb.accounts.roles import Role
from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import EvaError
from evaweb.lab import demo_rows, plan_runner, programs
from evaweb.lab.benches import Bench
from evaweb.lab.demo_rows import DemoLogin
from evaweb.lab.lab import Lab, open_lab
from evaweb.lab.lifetime import StopRequested
from evaweb.lab.progress import Progress, on_terminal
from evaweb.lab.rest_client import RestClient
from evaweb.lab.simulated import CLUMSY, POLICIES, SKILLED, benches_of, known_port, simulated_options
from evaweb.lab.single_trial import TrialChoice, report, run_one_trial
from evaweb.plans.models import Allocation, Plan, StoppingRule
from evaweb.results.analysis.analysis import Analysis
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.trials.models import Checkpoint
from runtime.core.durable_files import write_durably

_DEPLOYMENTS = settings.BASE_DIR / "deployments"
_MOST = 2000  # limit of --evaluate: more than a day
_STATION, _ROBOT = "bench-1", "agilex_piper"
_STEPS = 3  # progress steps besides those of any lab: bench, station, plan
_COLLECTS = (
    'collection.source="relay"',
    'collection.dataset="tabletop_demonstrations"',
    'collection.leader.kind="zmq"',
)


class Command(BaseCommand):
    """Command that runs the demo until Ctrl-C, or one trial with --once."""

    help = "A lab on this machine that needs no robot: web, worker, a simulated bench, two policy servers."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("--host", default="127.0.0.1", help="address that the web listens on")
        parser.add_argument("--port", type=int, default=8000, help="port of the web; 0 takes a free one")
        parser.add_argument(
            "--stop-port", type=int, help="port of the process for stops; the one after that of the web"
        )
        parser.add_argument("--once", action="store_true", help="run, score and publish one trial, then end")
        parser.add_argument(
            "--evaluate",
            type=int,
            metavar="N",
            help="carry out N trials of a blind plan without a human, in lockstep, reveal it, compare, then end",
        )
        parser.add_argument(
            "--design",
            choices=StoppingRule.values,
            default=StoppingRule.EVIDENCE.value,
            help="of --evaluate: what ends its comparison (none: a fixed number; evidence: anytime)",
        )
        parser.add_argument(
            "--order",
            choices=Allocation.values,
            default=Allocation.PAIRED.value,
            help="of --evaluate: each checkpoint once in a block, or whichever is drawn",
        )
        parser.add_argument(
            "--json", type=Path, metavar="FILE", help="with --once or --evaluate: write the result there"
        )
        parser.add_argument(
            "--ready-file", type=Path, help="write address and logins there as JSON, for scripts"
        )
        parser.add_argument("--robot", default=_ROBOT, help="which robot the simulated bench has")
        parser.add_argument(
            "--collect", action="store_true", help="the bench collects too, led by a simulated leader"
        )
        parser.add_argument(
            "--lockstep",
            action="store_true",
            help="bench, policies, leader and station in one process, whose time waits for a slow machine",
        )
        parser.add_argument("--seed", type=int, default=1, help="of the bench and of the policies")
        simulated_options(parser)
        parser.add_argument("--position", type=int, default=1, help="with --once: the position of the scene")
        parser.add_argument(
            "--checkpoint", default=SKILLED, choices=list(POLICIES), help="with --once: which policy"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        _check(options)
        deployment = _deployment(options["robot"])
        progress = on_terminal(Lab.STEPS + _STEPS)
        try:
            with open_lab(options["host"], options["port"], options["stop_port"], progress) as lab:
                url, logins = self._up(lab, deployment, options)
                if options["ready_file"]:
                    _announce(options["ready_file"], url, logins, lab.processes.pids())
                if options["once"]:
                    self._once(url, logins[0], options)
                elif options["evaluate"]:
                    self._evaluate(url, logins, options, progress)
                else:
                    self._welcome(url, logins)
                    lab.watch(benches_of(options))
        except StopRequested:
            self.stdout.write("ended; the data stays in " + str(settings.DATA_DIR))
        except EvaError as error:
            if options["json"]:
                options["json"].write_text(json.dumps({"error": str(error)}), "utf-8")
            raise CommandError(str(error)) from None

    def _up(self, lab: Lab, deployment: Path, options: dict[str, Any]) -> tuple[str, list[DemoLogin]]:
        with lab.progress.step("the simulated bench and its policies"):
            demo_rows.demo_scene()
            in_lockstep = options["evaluate"] or options["lockstep"]
            bench = (self._lockstep if in_lockstep else self._bench)(lab, deployment, options)
        url = lab.start([bench])
        with lab.progress.step("accounts and a plan"):
            roles = {"operator": Role.OPERATOR, "admin": Role.ADMIN}
            logins = [demo_rows.demo_login(username=name, role=role) for name, role in roles.items()]
            try:
                self._plan("block-on-plate-blind", "Block on plate", "evaluated", repetitions=3)
            except EvaError as error:
                self.stderr.write(f"The demo's plan is left as it is: {error}")
        return url, logins

    def _lockstep(self, lab: Lab, deployment: Path, options: dict[str, Any]) -> Bench:
        """Start bench, policies and station in one process on a virtual clock."""
        robot, how = options["robot"], benches_of(options)
        policies = {name: (how.skill(name), known_port(name)) for name in POLICIES}
        assignments = [
            f'robot="{robot}"',
            f'data_dir="{settings.DATA_DIR}"',
            f"policy.delay_ms={POLICIES[SKILLED].latency_ms}",
            *options["set"],
        ]
        assignments += _COLLECTS if options["collect"] else ()
        paced = () if options["evaluate"] else ("--paced",)  # in real time for people who watch
        program = programs.lockstep(str(deployment), assignments, robot, policies, (*how.options, *paced))
        urls = lab.processes.start(program)["policies"]
        how.write_copies(_STATION, robot, deployment, urls, assignments)
        for name, url in urls.items():
            served = {"url": url, "delay_ms": POLICIES[name].latency_ms}
            demo_rows.demo_checkpoint(name=name, description=POLICIES[name].description, policy=served)
        return Bench(deployment, assignments, runs=True)

    def _bench(self, lab: Lab, deployment: Path, options: dict[str, Any]) -> Bench:
        """Start bench, policies and station in separate processes."""
        robot, how = options["robot"], benches_of(options)
        bench = lab.processes.begin(programs.tabletop(robot, how.options))
        servers = {
            name: lab.processes.begin(programs.policy(name, robot, how.server(name), known_port(name)))
            for name in POLICIES
        }
        node, served = bench(), {name: server()["url"] for name, server in servers.items()}
        how.write_copies(_STATION, robot, deployment, served, [f'robot="{robot}"', *options["set"]])
        for name, scripted in POLICIES.items():
            demo_rows.demo_checkpoint(
                name=name, description=scripted.description, policy={"url": served[name]}
            )
        assignments = [
            f'robot="{robot}"',
            f'transport.sub_endpoint="{node["obs_endpoint"]}"',
            f'transport.pub_endpoint="{node["action_endpoint"]}"',
            f'policy.url="{served[SKILLED]}"',
            *options["set"],
        ]
        if options["collect"]:
            leader = lab.processes.start(programs.leader(robot, node["obs_endpoint"], how.seed))
            assignments += [*_COLLECTS, f'collection.leader.endpoint="{leader["endpoint"]}"']
        return Bench(deployment, assignments)

    def _plan(self, name: str, title: str, use: str, repetitions: int, **design: str) -> Plan:
        # The checkpoints of a blind plan are hidden from operators: single trials have their own.
        served = [Checkpoint.objects.get(name=policy) for policy in (SKILLED, CLUMSY)]
        checkpoints = [
            demo_rows.demo_checkpoint(
                name=f"{row.name}-{use}", description=row.description, policy=row.policy
            )
            for row in served
        ]
        first, second = checkpoints
        parts = {
            "owner": "admin",
            "positions": demo_rows.demo_scene().positions.all(),
            "checkpoints": checkpoints,
            "question": f"Does {first} put the block on the plate more often than {second}?",
        }
        return demo_rows.demo_plan(name=name, title=title, repetitions=repetitions, **parts, **design)

    def _welcome(self, url: str, logins: list[DemoLogin]) -> None:
        self.stdout.write(f"\nEVA Web is at {url}\n")
        for login in logins:
            self.stdout.write(f"  {login.username:<10}{login.password}")
        self.stdout.write(f"\nThe data is in {settings.DATA_DIR}, logs in its folder logs.")
        self.stdout.write("Ctrl-C ends everything.")
        self.stdout.flush()

    def _evaluate(
        self, url: str, logins: list[DemoLogin], options: dict[str, Any], progress: Progress
    ) -> None:
        begun, count = time.monotonic(), options["evaluate"]
        name = f"evaluate-{time.strftime('%Y%m%d-%H%M%S')}"
        positions = demo_rows.demo_scene().positions.count()
        plan = self._plan(
            name,
            f"{count} trials by the script",
            "by-script",
            repetitions=-(-count // (2 * positions)),
            design=options["design"],
            order=options["order"],
        )
        self.stderr.write(f"{plan}: commitment {plan.commitment}")
        visitors = [RestClient(url) for _ in logins]
        for visitor, login in zip(visitors, logins, strict=True):
            visitor.login(login.username, login.password)
        completed = plan_runner.run_plan(
            visitors[0], _STATION, name, count, self.stderr.write, progress, lockstep=True
        )
        with progress.during("the reveal, and what came out"):
            result = plan_runner.close_and_reveal(visitors[1], name, completed)
            plan.refresh_from_db()
            evaluated = PlanResult(plan)
            analysis = evaluated.analysis
        result["headline"] = evaluated.headline.sentence if evaluated.headline else ""
        result |= {"lockstep": True, "analysis": asdict(analysis), "wall_s": time.monotonic() - begun}
        if options["json"]:
            options["json"].write_text(json.dumps(to_json_value(result), indent=1), "utf-8")
        for line in (*result_lines(analysis), result["headline"]):
            self.stdout.write(line)

    def _once(self, url: str, operator: DemoLogin, options: dict[str, Any]) -> None:
        visitor = RestClient(url)
        visitor.login(operator.username, operator.password)
        choice = TrialChoice(
            _STATION, "block-on-plate", options["position"], options["checkpoint"], options["seed"]
        )
        completed = run_one_trial(visitor, choice)
        text = json.dumps(report(completed), indent=1)
        if options["json"]:
            options["json"].write_text(text, "utf-8")
        self.stdout.write(text)


def result_lines(found: Analysis) -> Iterator[str]:
    """Yield a line per rate with its interval, a line per difference with its interval, and the notes."""
    for arm in found.arms:
        yield f"{arm.checkpoint}: {arm.success.successes}/{arm.success.n} {_percent(arm.success.interval)}"
    for comparison in found.comparisons:
        yield (
            f"{comparison.first} against {comparison.second}: "
            f"difference {100 * comparison.difference.value:.0f} points "
            f"{_percent(comparison.difference.interval)}, {comparison.pairs} pairs"
        )
    for note in found.notes:
        yield f"  {note}"


def _percent(interval: Any) -> str:
    return f"[{100 * interval.low:.0f}, {100 * interval.high:.0f}] %" if interval else "[no interval]"


def _check(options: Mapping[str, Any]) -> None:
    count = options["evaluate"]
    if count is not None and (count < 2 or count % 2 or count > _MOST):
        raise CommandError(
            f"--evaluate {count}: allowed: an even number from 2 to {_MOST}, two checkpoints have a trial each"
        )
    if count is not None and options["once"]:
        raise CommandError("--evaluate with --once: name one of them")
    if count is not None and options["collect"]:
        raise CommandError("--evaluate with --collect: nobody collects meanwhile; leave one out")
    if count is not None and options["lockstep"]:
        raise CommandError(
            "--evaluate with --lockstep: it is in lockstep, and faster than life; leave one out"
        )


def _deployment(robot: str) -> Path:
    """Return the tabletop's deployment for that robot, else the generic one.

    Raises:
        CommandError: If the robot does not exist.
    """
    if robot not in robots.robot_names():
        raise CommandError(f"--robot {robot}: allowed: {', '.join(robots.robot_names())}")
    own = _DEPLOYMENTS / f"tabletop_{robot}.toml"
    return own if own.is_file() else _DEPLOYMENTS / "tabletop.toml"


def _announce(path: Path, url: str, logins: list[DemoLogin], pids: Mapping[str, int]) -> None:
    """Write address, passwords and process ids atomically, readable only by this account."""
    passwords = {login.username: login.password for login in logins}
    ready = {"url": url, "passwords": passwords, "pids": dict(pids)}
    write_durably(path, json.dumps(ready).encode(), 0o600)
