"""`manage.py metaworld`: a lab with Meta-World's fifty tasks, and its scripted experts as policy servers."""

from __future__ import annotations

import os
from argparse import ArgumentParser
from typing import Any

from django.conf import settings
from django.core.management.base import BaseCommand, CommandError

from evaweb.accounts.roles import Role
from evaweb.core.errors import EvaError
from evaweb.lab import demo_rows, programs
from evaweb.lab.benches import Bench
from evaweb.lab.lab import Lab, open_lab
from evaweb.lab.lifetime import StopRequested
from evaweb.lab.progress import on_terminal
from evaweb.lab.simulated import benches_of, known_port
from evaweb.plans.models import Plan, StoppingRule
from evaweb.trials.models import Checkpoint, Scene
from runtime.benches.environments import UnusableEnvironment, make_environment
from runtime.benches.schema import load_schema

_BENCH, _STATION = "metaworld", "metaworld"
_DEPLOYMENT = settings.BASE_DIR / "deployments" / "metaworld.toml"
_EXPERTS = {  # by checkpoint: noise that is added to rows, and its description
    "metaworld-expert": (0.0, "Meta-World's scripted experts, each for its own task."),
    "metaworld-expert-noisy": (1.0, "The same with noise of one sigma = 1 on every number of a row."),
}
_PLAN = "metaworld-experts"
_TASKS = (
    *("reach-v3", "push-v3", "pick-place-v3", "door-open-v3", "drawer-open-v3"),
    *(
        "drawer-close-v3",
        "button-press-topdown-v3",
        "peg-insert-side-v3",
        "window-open-v3",
        "window-close-v3",
    ),
)
_REPETITIONS = 5
_TIME_LIMIT_S = 10.0  # more than the benchmark's own 500 steps of 1/80 s
_STEPS = 4  # progress steps besides those of any lab: environment, tasks, experts, plan


class Command(BaseCommand):
    """Command that runs a lab with Meta-World until Ctrl-C."""

    help = "A lab on this machine with Meta-World: its tasks as scenes, its experts as checkpoints, a blind plan."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("--host", default="127.0.0.1", help="address that the web listens on")
        parser.add_argument("--port", type=int, default=8000, help="port of the web; 0 takes a free one")
        parser.add_argument(
            "--stop-port", type=int, help="port of the process for stops; the one after that of the web"
        )
        parser.add_argument(
            "--pictures", type=int, default=224, metavar="PIXELS", help="width and height of pictures"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        progress = on_terminal(Lab.STEPS + 1 + _STEPS)
        size = options["pictures"]
        if not 16 <= size <= 1024:
            raise CommandError(f"--pictures {size}: allowed: 16 to 1024")
        try:
            with progress.step("the environment of Meta-World, once: some 250 MB"):
                os.environ["EVA_DATA_DIR"] = str(settings.DATA_DIR)  # as for the programs of the lab
                make_environment(_BENCH)
            with open_lab(options["host"], options["port"], options["stop_port"], progress) as lab:
                self._up(lab, (size, size))
                lab.watch(benches_of({"pictures": (size, size), "set": []}))
        except StopRequested:
            self.stdout.write("ended; the data stays in " + str(settings.DATA_DIR))
        except (EvaError, UnusableEnvironment) as error:
            raise CommandError(str(error)) from None

    def _up(self, lab: Lab, pictures: tuple[int, int]) -> None:
        with lab.progress.step("its tasks as scenes"):
            for task in load_schema(_BENCH).choices["task"].values:
                _scene(task)
        with lab.progress.step("its experts"):
            for name, (noise, description) in _EXPERTS.items():
                options = ("--name", name, "--noise", str(noise))
                program = programs.at_bench(f"policy-{name}", _BENCH, "experts.py", options, known_port(name))
                served = {"url": lab.processes.start(program)["url"]}
                demo_rows.demo_checkpoint(name=name, description=description, policy=served)
        first = Checkpoint.objects.get(name=next(iter(_EXPERTS))).policy["url"]
        how = benches_of({"pictures": pictures, "set": []})
        url = lab.start([Bench(_DEPLOYMENT, [f'policy.url="{first}"'], options=how.options)])
        with lab.progress.step("accounts and a plan"):
            roles = {"operator": Role.OPERATOR, "admin": Role.ADMIN}
            logins = [demo_rows.demo_login(username=name, role=role) for name, role in roles.items()]
            try:
                plan = _plan()
            except EvaError as error:
                plan = None
                self.stderr.write(f"The plan {_PLAN} is left as it is: {error}")
        self.stdout.write(f"\nEVA Web is at {url}\n")
        for login in logins:
            self.stdout.write(f"  {login.username:<10}{login.password}")
        if plan is not None:
            self.stdout.write(
                f"\nThe plan {plan.name} is carried out from its page, under Without people, or by\n"
                f"  manage.py evaluate {plan.name} --station {_STATION} --copies 2"
            )
        self.stdout.write("Ctrl-C ends everything.")
        self.stdout.flush()


def _scene(task: str) -> Scene:
    """Return the scene of a task; its pictures are plain, because no expert looks at them."""
    return demo_rows.benchmark_scene(bench=_BENCH, task=task, time_limit_s=_TIME_LIMIT_S, pictures="plain")


def _plan() -> Plan:
    """Return the frozen blind plan of ten tasks, experts against experts with noise."""
    scenes = [_scene(task) for task in _TASKS]
    # The checkpoints of a blind plan are hidden from operators: single trials have their own.
    served = [Checkpoint.objects.get(name=name) for name in _EXPERTS]
    checkpoints = [
        demo_rows.demo_checkpoint(
            name=f"{row.name}-evaluated", description=row.description, policy=row.policy
        )
        for row in served
    ]
    return demo_rows.demo_plan(
        name=_PLAN,
        title="Meta-World: experts with and without noise",
        question="How much does noise on every number of a row cost Meta-World's experts?",
        owner="admin",
        positions=[position for scene in scenes for position in scene.positions.all()],
        checkpoints=checkpoints,
        repetitions=_REPETITIONS,
        design=StoppingRule.NONE,
    )
